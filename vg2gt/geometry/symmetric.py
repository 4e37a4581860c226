"""Closed-form eigenvectors of batches of small symmetric matrices."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F

UPPER = ((0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2))  # rows and columns of a symmetric 3x3 matrix's upper triangle
FULL = (0, 1, 2, 1, 3, 4, 2, 4, 5)  # index of each of its nine entries among those six


def smallest_eigenvector(matrix: Tensor, fallback: Tensor) -> Tensor:
    """Returns the unit eigenvector of the smallest eigenvalue of symmetric 3x3 matrices.

    The eigenvalue is the trigonometric root of the characteristic cubic, the eigenvector the longest cross product of
    two rows of ``A - lambda I``. Computed in float64, so that float32 input keeps its precision.

    Args:
        matrix: ``[..., 3, 3]`` symmetric, finite, of any magnitude.
        fallback: ``[..., 3]`` unit vectors, returned where the smallest eigenvalue is not simple (isotropic, zero or
            line-like matrices) and the eigenvector is not unique.

    Returns:
        ``[..., 3]`` in the input's dtype; the sign is arbitrary.
    """
    a = matrix.double()
    size = a.abs().amax((-2, -1), keepdim=True)
    a = a / size.clamp(min=1e-300)  # [..., 3, 3], largest entry 1
    eye = torch.eye(3, dtype=a.dtype, device=a.device)
    mean = a.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None]  # [..., 1, 1]
    centered = a - mean * eye
    radius = (centered.square().sum((-2, -1)) / 6).sqrt()  # [...]
    unit = centered / radius.clamp(min=1e-300)[..., None, None]
    first, second, third = unit.unbind(-2)
    determinant = (first * torch.linalg.cross(second, third)).sum(-1)
    angle = (determinant / 2).clamp(-1, 1).acos() / 3  # in [0, pi / 3]
    smallest = mean[..., 0, 0] + 2 * radius * torch.cos(angle + 2 * math.pi / 3)
    rows = (a - smallest[..., None, None] * eye).unbind(-2)
    candidates = torch.stack([torch.linalg.cross(rows[i], rows[j]) for i, j in ((0, 1), (0, 2), (1, 2))], -2)
    lengths = candidates.norm(dim=-1)  # [..., 3]
    best = lengths.argmax(-1, keepdim=True)
    vector = candidates.take_along_dim(best[..., None], -2)[..., 0, :]
    # its length is the product of the distances to the two other eigenvalues: small if one of them is as small
    single = lengths.take_along_dim(best, -1) > 1e-6
    return torch.where(single, F.normalize(vector, dim=-1, eps=1e-300), fallback.double()).to(matrix.dtype)


def principal_direction(a: Tensor, b: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the principal direction and largest eigenvalue of symmetric 2x2 matrices ``((a, b), (b, c))``.

    Args:
        a: ``[...]``.
        b: ``[...]``.
        c: ``[...]``.

    Returns:
        The unit eigenvector ``[..., 2]`` of the largest eigenvalue, with arbitrary sign, ``(1, 0)`` if both eigenvalues
        are equal; and the eigenvalue ``[...]``.
    """
    angle = 0.5 * torch.atan2(2 * b, a - c)
    largest = 0.5 * (a + c + torch.hypot(a - c, 2 * b))
    return torch.stack((angle.cos(), angle.sin()), -1), largest
