"""Real spherical harmonics up to degree 3, in the order and sign convention of 3D Gaussian Splatting."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

MAX_DEGREE = 3
DC = 0.28209479177387814  # 1 / (2 sqrt(pi))


def basis(directions: Tensor, degree: int) -> Tensor:
    """Evaluates the basis.

    Args:
        directions: ``[..., 3]`` unit vectors.
        degree: highest degree L, 0 to 3.

    Returns:
        ``[..., (L + 1)^2]``.

    Raises:
        ValueError: if the degree is out of range.
    """
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"spherical-harmonic degree must be 0 to {MAX_DEGREE}, got {degree}")
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, DC)]
    if degree >= 1:
        c = 0.4886025119029199
        values += [-c * y, c * z, -c * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        c = 1.0925484305920792
        values += [c * x * y, -c * y * z, 0.31539156525252005 * (2 * zz - xx - yy), -c * x * z, c / 2 * (xx - yy)]
    if degree >= 3:
        xx, yy, zz = x * x, y * y, z * z
        values += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return torch.stack(values, -1)


def rotation_of_coefficients(rotation: Tensor, degree: int) -> Tensor:
    """Returns matrices that rotate functions on the sphere by transforming their coefficients.

    Args:
        rotation: ``[..., 3, 3]``, such as camera to world.
        degree: highest degree L, 0 to 3.

    Returns:
        ``[..., (L + 1)^2, (L + 1)^2]``: the value of coefficients ``M c`` along ``rotation @ d`` is that of ``c`` along
        ``d``.

    Raises:
        ValueError: if the degree is out of range.
    """
    # each degree is closed under rotation, so values along enough directions determine the rotated coefficients
    axis = torch.arange(-1, 2, dtype=torch.float64, device=rotation.device)
    directions = torch.cartesian_prod(axis, axis, axis)
    directions = F.normalize(directions[directions.any(-1)], dim=-1)
    before = basis(directions @ rotation.double(), degree)
    return (torch.linalg.pinv(basis(directions, degree)) @ before).to(rotation.dtype)


def rgb_to_sh(rgb: Tensor) -> Tensor:
    """Returns the degree-0 coefficient of a colour in [0, 1]."""
    return (rgb - 0.5) / DC


def sh_to_rgb(sh: Tensor, directions: Tensor) -> Tensor:
    """Returns the colours seen along viewing directions.

    Args:
        sh: ``[..., (L + 1)^2, 3]``.
        directions: ``[..., 3]`` unit vectors from the camera centre to the point.

    Returns:
        ``[..., 3]``, clamped to >= 0 as in 3DGS.
    """
    degree = round(sh.shape[-2] ** 0.5) - 1
    return ((basis(directions, degree)[..., None] * sh).sum(-2) + 0.5).clamp(min=0)
