"""Depth ranges: from the cameras alone, and from the depths of a first search."""

from __future__ import annotations

import torch
from torch import Tensor

from backends.sweep.views import camera_distances

_WIDE = (0.1, 40.0)  # range of the first search, in units of the largest distance between cameras
_NEAREST = 0.03  # minimum near of the first search, in the same unit


def wide_range(world_to_camera: Tensor) -> Tensor:
    """Returns near and far ``[2]`` of a first search, from the cameras ``[V, 4, 4]`` alone.

    Near is at most the median distance of a camera to its nearest neighbour, but not below a minimum. In long captures
    the largest distance says little about how near surfaces are, while the steps between views match their distance.
    """
    distances = camera_distances(world_to_camera)
    extent = distances.max()
    step = distances.fill_diagonal_(torch.inf).min(1).values.median()
    near = torch.minimum(_WIDE[0] * extent, step.clamp_min(_NEAREST * extent))
    return torch.stack((near, _WIDE[1] * extent))


def range_of(depth: Tensor, chosen: Tensor, fallback: Tensor) -> Tensor:
    """Returns near and far ``[2]`` around the depths of some pixels.

    Args:
        depth: depth of the pixels, of any shape.
        chosen: which of them count, of the same shape.
        fallback: range ``[2]`` to return if these are less than 1 % of the pixels.
    """
    counted = depth[chosen].sort().values
    if len(counted) < 0.01 * depth.numel():
        return fallback
    low, high = counted[int(0.01 * len(counted))], counted[int(0.99 * len(counted))]
    return torch.stack((low * 0.8, high * 1.4))
