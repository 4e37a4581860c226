"""Depth planes that need no depth range, and the sources of views."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F

from backends.sweep.views import camera_distances, camera_extent, choose_sources

SOURCES = 6  # of a view; with three of them at 1/4 and 1/2, unseen rooms have 12 % more error
_NEAREST = 0.15  # depth of the nearest plane, in baselines
_BEND = 40.0  # planes nearer than this many baselines are spaced in log-depth, farther ones in inverse depth
_SPAN = math.log1p(_BEND / _NEAREST)
PLANES = 64  # of the first stage
FARTHEST = 0.1 / (PLANES - 1)  # smallest position of a hypothesis: thousands of baselines away
_SCORED = (0.7, 30.0)  # near and far, in baselines, of the points whose visibility scores the sources
_LEAST_BASELINE = 0.02  # in extents of the cameras


def baselines(world_to_camera: Tensor) -> Tensor:
    """Returns the unit of length of each view's planes ``[V]``: the median distance to its nearest cameras.

    If that is too short, because the camera rested, only cameras farther away count.

    Args:
        world_to_camera: ``[V, 4, 4]``, not all in one place.
    """
    distances = camera_distances(world_to_camera)
    least = _LEAST_BASELINE * camera_extent(distances)
    others = distances.fill_diagonal_(torch.inf)
    count = min(SOURCES, len(others) - 1)
    nearest = others.sort(1).values[:, :count].median(1).values
    apart = others.masked_fill(others < least, torch.inf).sort(1).values[:, :count]
    middle = (apart.isfinite().sum(1, keepdim=True) - 1) // 2
    return torch.where(nearest < least, apart.gather(1, middle)[:, 0], nearest)


def sources_of(
    world_to_camera: Tensor,
    intrinsics: Tensor,
    size: tuple[int, int],
    count: int = SOURCES,
    noise: Tensor | None = None,
) -> Tensor:
    """Chooses the sources of the views of one scene from the cameras alone; see :func:`choose_sources`."""
    searched = baselines(world_to_camera)[:, None] * world_to_camera.new_tensor(_SCORED)
    return choose_sources(world_to_camera, intrinsics, size, searched, count, noise)


class Planes:
    """Positions of depth planes from infinity (0) to a fraction of a view's baseline (1).

    The position is ``log(1 + 40 b / depth)`` over its largest value, b being the view's baseline: far planes are spaced
    evenly in inverse depth, that is in disparity, and near ones in log-depth.

    Args:
        baseline: ``[V]``.
    """

    def __init__(self, baseline: Tensor) -> None:
        self.scale = _BEND * baseline.view(-1, 1, 1, 1)

    def inverse(self, position: Tensor) -> Tensor:
        """Converts positions ``[V, ., h, w]`` to inverse depth."""
        return torch.expm1(_SPAN * position.clamp(FARTHEST, 1.1)) / self.scale

    def position(self, log_depth: Tensor) -> Tensor:
        """Converts log-depth ``[V, ., h, w]`` to positions."""
        return F.softplus(self.scale.log() - log_depth) / _SPAN
