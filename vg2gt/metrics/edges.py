"""Where depth breaks off: the pixels in which reconstructions show their fringes."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

EDGE = 0.05  # relative step of depth between neighbouring pixels
NEAR = 3  # pixels


def near_depth_edges(depth: Tensor, step: float = EDGE, near: int = NEAR) -> Tensor:
    """Pixels ``[..., H, W]`` at most ``near`` pixels (along either axis) from a depth edge.

    An edge is a relative step of z-depth ``[..., H, W]`` above ``step`` between valid (> 0) neighbours.
    """
    valid = depth > 0
    edges = torch.zeros_like(valid)
    for axis in (-1, -2):
        first, second = depth.narrow(axis, 0, depth.shape[axis] - 1), depth.narrow(axis, 1, depth.shape[axis] - 1)
        both = valid.narrow(axis, 0, depth.shape[axis] - 1) & valid.narrow(axis, 1, depth.shape[axis] - 1)
        broken = both & ((first - second).abs() > step * torch.minimum(first, second))
        edges.narrow(axis, 0, depth.shape[axis] - 1).logical_or_(broken)
        edges.narrow(axis, 1, depth.shape[axis] - 1).logical_or_(broken)
    flat = edges.to(torch.float32).flatten(0, -3)[:, None]  # [N, 1, H, W]
    # A pixel next to an edge is half a pixel from it: near - 1 more steps reach the distance.
    return (F.max_pool2d(flat, 2 * near - 1, 1, near - 1) > 0).reshape(depth.shape)
