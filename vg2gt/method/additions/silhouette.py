"""Detects pixels between foreground and background, which lie on no surface (our addition to both levels of the paper).

Decoded depth changes from foreground to background over a few pixels. In voxels, these pixels form a fringe of
floating fragments around every object.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

TOLERANCE = 0.015  # largest relative distance of a pixel from the plane through two neighbours on the same side
_STEEPEST = 0.12  # relative change of depth per pixel above which not even a plane counts as a surface
CONTRAST = 0.08  # relative depth range of a window below which there is no silhouette
_INSIDE = 0.05  # share of that range by which a pixel must lie behind the front and before the back
REACH = 2  # pixels to each side, window of the depth range
STEP = 0.15  # relative depth range around a pixel from which on it is next to a silhouette
_STEP_REACH = 3  # pixels to each side, window of STEP


def on_surface(depth: Tensor) -> Tensor:
    """Returns which pixels lie on a surface, as opposed to between foreground and background.

    Inverse depth is linear in the image of a plane, so along each axis a pixel of a surface lies on the line through
    the two neighbours of at least one side. A pixel is on no surface if both conditions hold:

    - It violates this along an axis, or its depth changes too fast on both sides.
    - It lies strictly within the depth range of its 5 x 5 window, and that range is large.

    Noise and fine relief without a silhouette are therefore kept.

    Args:
        depth: ``[..., H, W]`` z-depth in any unit, 0 = invalid.

    Returns:
        ``[..., H, W]`` bool, undefined at invalid pixels.
    """
    valid = depth > 0
    inverse = torch.where(valid, 1 / torch.where(valid, depth, 1.0), 0.0)
    broken = torch.zeros_like(valid)
    for axis in (depth.dim() - 1, depth.dim() - 2):
        before, before2, after, after2 = (_shifted(inverse, axis, by) for by in (-1, -2, 1, 2))
        off_plane = torch.minimum((inverse - 2 * before + before2).abs(), (inverse - 2 * after + after2).abs())
        step = torch.minimum((inverse - before).abs(), (inverse - after).abs())
        broken |= (off_plane > TOLERANCE * inverse) | (step > _STEEPEST * inverse)
    near, far = _depth_range(depth, REACH)
    margin = _INSIDE * (far - near)
    between = (far > (1 + CONTRAST) * near) & (depth > near + margin) & (depth < far - margin)
    return ~(broken & between)


def near_silhouettes(depth: Tensor) -> Tensor:
    """Returns which pixels lie on no surface, or on a surface that ends within a few pixels.

    Args:
        depth: ``[..., H, W]`` z-depth in any unit, 0 = invalid.

    Returns:
        ``[..., H, W]`` bool; false where the depth is invalid.
    """
    near, far = _depth_range(depth, _STEP_REACH)
    return (depth > 0) & ((far >= (1 + STEP) * near) | ~on_surface(depth))


def _depth_range(depth: Tensor, reach: int) -> tuple[Tensor, Tensor]:
    """Returns the smallest and largest valid depth within ``reach`` pixels to each side, in the shape of ``depth``."""
    return -_largest(-torch.where(depth > 0, depth, torch.inf), reach), _largest(depth, reach)


def _largest(values: Tensor, reach: int) -> Tensor:
    """Returns the largest value within ``reach`` pixels to each side; on CPUs many times faster than ``max_pool2d``."""
    for axis in (values.dim() - 1, values.dim() - 2):
        border = [0, 0] * (values.dim() - 1 - axis) + [reach, reach]
        values, width, window = F.pad(values, border, value=-torch.inf), 1, 2 * reach + 1
        while width < window:  # doubles the window each time
            by = min(width, window - width)
            length = values.shape[axis] - by
            values, width = torch.maximum(values.narrow(axis, 0, length), values.narrow(axis, by, length)), width + by
    return values


def _shifted(values: Tensor, axis: int, by: int) -> Tensor:
    """Returns ``values[i + by]`` at ``i``, with indices clamped at the borders."""
    length = values.shape[axis]
    index = (torch.arange(length, device=values.device) + by).clamp(0, length - 1)
    return values.index_select(axis, index)
