"""Depth planes that need no depth range, and the sources of views."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F

from backends.sweep.views import camera_distances, camera_extent, choose_sources

COARSE_SOURCES, _FINE_SOURCES = 6, 3
_NEAREST = 0.15  # depth of the nearest plane, in baselines
_BEND = 40.0  # planes nearer than this many baselines are spaced in log-depth, farther ones in inverse depth
_SPAN = math.log1p(_BEND / _NEAREST)
PLANES = 64  # of the first stage
FARTHEST = 0.1 / (PLANES - 1)  # smallest position of a hypothesis: thousands of baselines away
_SCORED = (0.7, 30.0)  # near and far, in baselines, of the points whose visibility scores the sources
_LEAST_BASELINE = 0.02  # in extents of the cameras
_ENOUGH_PARALLAX, _WIDE_PARALLAX = 0.06, 0.4  # baseline over depth: see fine_sources
_SEEN_AGAIN = 0.6  # share of its weight that a pixel loses with every source that sees it


def baselines(world_to_camera: Tensor) -> Tensor:
    """Returns the unit of length of each view's planes ``[V]``: the median distance to its nearest cameras.

    If that is too short, because the camera rested, only cameras farther away count.

    Args:
        world_to_camera: ``[V, 4, 4]``, not all in one place.
    """
    distances = camera_distances(world_to_camera)
    least = _LEAST_BASELINE * camera_extent(distances)
    others = distances.fill_diagonal_(torch.inf)
    count = min(COARSE_SOURCES, len(others) - 1)
    nearest = others.sort(1).values[:, :count].median(1).values
    apart = others.masked_fill(others < least, torch.inf).sort(1).values[:, :count]
    middle = (apart.isfinite().sum(1, keepdim=True) - 1) // 2
    return torch.where(nearest < least, apart.gather(1, middle)[:, 0], nearest)


def coarse_sources(
    world_to_camera: Tensor,
    intrinsics: Tensor,
    size: tuple[int, int],
    count: int = COARSE_SOURCES,
    noise: Tensor | None = None,
) -> Tensor:
    """Chooses the sources of the views of one scene from the cameras alone; see :func:`choose_sources`."""
    searched = baselines(world_to_camera)[:, None] * world_to_camera.new_tensor(_SCORED)
    return choose_sources(world_to_camera, intrinsics, size, searched, count, noise)


def fine_sources(visible: Tensor, parallax: Tensor, count: int = _FINE_SOURCES) -> Tensor:
    """Chooses the best of the coarse sources, greedily, by what they see and the parallax they see it with.

    Args:
        visible: estimated visibility of the pixels of each view in its sources ``[V, n, p]``.
        parallax: distance of the cameras over depth ``[V, n, p]``.
        count: number of sources per view; at most n are returned.

    Returns:
        Columns of the chosen sources ``[V, count]``, best first.
    """
    score = visible * parallax / (parallax + _ENOUGH_PARALLAX) / (1 + (parallax / _WIDE_PARALLAX) ** 2)
    left = torch.ones_like(score[:, 0])
    chosen = []
    for _ in range(min(count, score.shape[1])):
        total = (score * left[:, None]).mean(-1)
        for before in chosen:
            total = total.scatter(1, before[:, None], -torch.inf)
        chosen.append(total.argmax(1))
        best = visible.gather(1, chosen[-1][:, None, None].expand(-1, 1, visible.shape[2]))[:, 0]
        left = left * (1 - _SEEN_AGAIN * best)
    return torch.stack(chosen, 1)


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
