"""Surface normals of depth maps, without computing points.

A pixel's ray is ``r = (u, v, 1)`` and its point ``d r``. The chord between the points of its left and right neighbours,
with depths d0 and d1, is ``(d1 - d0) r + (d1 + d0) / fx e_x``. Its cross product with the chord of the column is
proportional to ``(gx, gy, -1 - u gx - v gy)``, with ``gx = fx (d1 - d0) / (d1 + d0)`` and the same for ``gy``. It never
vanishes and always faces the camera. kornia's ``depth_to_normals`` handles neither holes nor depth edges.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F


def ray_slopes(intrinsics: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Returns u ``[..., 1, W]`` and v ``[..., H, 1]`` of the rays ``(u, v, 1)`` of all pixels.

    Args:
        intrinsics: ``[..., 3, 3]`` in pixels, integer pixel centres.
        size: image ``(height, width)``.
    """
    height, width = size
    x = torch.arange(width, dtype=intrinsics.dtype, device=intrinsics.device)
    y = torch.arange(height, dtype=intrinsics.dtype, device=intrinsics.device)[:, None]
    fx, fy, cx, cy = (intrinsics[..., i, j, None, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return (x - cx) / fx, (y - cy) / fy


def _neighbours(maps: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Returns the left, right, upper and lower neighbours ``[..., H - 2, W - 2]`` of the inner pixels."""
    return maps[..., 1:-1, :-2], maps[..., 1:-1, 2:], maps[..., :-2, 1:-1], maps[..., 2:, 1:-1]


def normals_from_depth(depth: Tensor, intrinsics: Tensor, edge_threshold: float = 0.05) -> tuple[Tensor, Tensor]:
    """Returns camera-frame normals from central differences of unprojected points.

    Args:
        depth: ``[..., H, W]`` z-depth in any unit, 0 = invalid.
        intrinsics: ``[..., 3, 3]`` in pixels, integer pixel centres.
        edge_threshold: largest relative depth difference between a pixel and its four neighbours; pixels above it are
            at a depth edge and have no normal.

    Returns:
        Unit normals ``[..., 3, H, W]`` facing the camera (0 where invalid), differentiable in the depth with finite
        gradients, and their validity ``[..., H, W]``.
    """
    present = depth > 0
    filled = torch.where(present, depth, 1.0)
    center = filled[..., 1:-1, 1:-1]
    left, right, up, down = _neighbours(filled)
    limit = (edge_threshold * center).detach()
    smooth = (torch.stack((left, right, up, down)).detach() - center.detach()).abs() <= limit
    valid = torch.stack((present[..., 1:-1, 1:-1], *_neighbours(present))).all(0) & smooth.all(0)

    u, v = ray_slopes(intrinsics, (depth.shape[-2], depth.shape[-1]))
    gx = intrinsics[..., 0, 0, None, None] * (right - left) / (right + left)
    gy = intrinsics[..., 1, 1, None, None] * (down - up) / (down + up)
    gx, gy = torch.where(valid, gx, 0.0), torch.where(valid, gy, 0.0)
    normals = torch.stack((gx, gy, -1 - u[..., 1:-1] * gx - v[..., 1:-1, :] * gy), -3)
    normals = normals / normals.square().sum(-3, keepdim=True).sqrt()
    normals = torch.where(valid[..., None, :, :], normals, 0.0)
    return F.pad(normals, (1, 1, 1, 1)), F.pad(valid, (1, 1, 1, 1))
