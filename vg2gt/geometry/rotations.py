"""Quaternions (wxyz) and rotation matrices; kornia's differ in the last bits, which would change every training run."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F


def quat_to_matrix(quats: Tensor) -> Tensor:
    """Returns rotation matrices ``[..., 3, 3]`` of quaternions ``[..., 4]`` (wxyz), which are normalised first."""
    unit = F.normalize(quats, dim=-1)
    # all products at once; twice them, which is exact
    w, x, y, z = (row.unbind(-1) for row in (2 * (unit[..., :, None] * unit[..., None, :])).unbind(-2))
    elements = (
        *(1 - (y[2] + z[3]), x[2] - w[3], x[3] + w[2]),
        *(x[2] + w[3], 1 - (x[1] + z[3]), y[3] - w[1]),
        *(x[3] - w[2], y[3] + w[1], 1 - (x[1] + y[2])),
    )
    return torch.stack(elements, -1).unflatten(-1, (3, 3))


def matrix_to_quat(matrix: Tensor) -> Tensor:
    """Returns unit quaternions ``[..., 4]`` (wxyz, w >= 0) of rotation matrices ``[..., 3, 3]``."""
    m = matrix
    diagonal = torch.stack((m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]), -1)
    trace = diagonal.sum(-1, keepdim=True)
    squares = torch.cat((1 + trace, 1 + 2 * diagonal - trace), -1)  # four times each squared component
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 1, 0] + m[..., 0, 1], m[..., 2, 0] + m[..., 0, 2], m[..., 2, 1] + m[..., 1, 2]
    w2, x2, y2, z2 = squares.unbind(-1)
    outer = torch.stack(
        [torch.stack(row, -1) for row in ((w2, wx, wy, wz), (wx, x2, xy, xz), (wy, xy, y2, yz), (wz, xz, yz, z2))], -2
    )
    best = squares.argmax(-1)[..., None, None].expand(*outer.shape[:-2], 1, 4)
    quats = F.normalize(torch.gather(outer, -2, best)[..., 0, :], dim=-1)
    return torch.where(quats[..., :1] < 0, -quats, quats)


def multiply_quats(first: Tensor, second: Tensor) -> Tensor:
    """Returns the Hamilton product of quaternions ``[..., 4]`` (wxyz): rotation ``second``, followed by ``first``."""
    w, v = first[..., :1], first[..., 1:]
    other_w, other_v = second[..., :1], second[..., 1:]
    scalar = w * other_w - (v * other_v).sum(-1, keepdim=True)
    return torch.cat((scalar, w * other_v + other_w * v + torch.linalg.cross(v, other_v)), -1)
