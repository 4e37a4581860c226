"""Depth planes that need no depth range."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F

_NEAREST = 0.15  # depth of the nearest plane, in baselines
_BEND = 40.0  # planes nearer than this many baselines are spaced in log-depth, farther ones in inverse depth
_SPAN = math.log1p(_BEND / _NEAREST)
PLANES = 64  # of the first stage
FARTHEST = 0.1 / (PLANES - 1)  # smallest position of a hypothesis: thousands of baselines away


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
