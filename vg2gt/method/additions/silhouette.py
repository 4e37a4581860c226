"""Points between foreground and background, which lie on no surface (our addition to both levels of the paper).

Decoded depth runs from the foreground to the background within a few pixels; in voxels they become a fringe of
splinters around every object.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

TOLERANCE = 0.015  # relative, of a pixel's depth to the plane through two neighbours on the same side
STEEPEST = 0.12  # relative change of depth from pixel to pixel beyond which even a plane says nothing
CONTRAST = 0.08  # relative range of depth in a window without which there is no silhouette
INSIDE = 0.05  # share of that range by which a pixel lies behind the front and before the back
REACH = 2  # pixels to every side in which the range of depth is taken
STEP = 0.15  # relative range of depth around a pixel from which on it is next to a silhouette
STEP_REACH = 3  # pixels to every side


def on_surface(depth: Tensor) -> Tensor:
    """Tells the pixels of a surface from those between foreground and background.

    Inverse depth is linear in the image of a plane, so a surface's pixel lies on the line through its two neighbours to
    the left or on that through those to the right, or up and down. A pixel that fails this along either axis,
    or whose depth changes too fast on both sides, and that lies strictly within the depth range of its 5 x 5 window
    where that range is large, is on no surface. Noise and fine relief without a silhouette are left alone.

    Args:
        depth: ``[..., H, W]`` z-depth in any unit, 0 = invalid.

    Returns:
        ``[..., H, W]`` bool; what it says of invalid pixels means nothing.
    """
    valid = depth > 0
    inverse = torch.where(valid, 1 / torch.where(valid, depth, 1.0), 0.0)
    broken = torch.zeros_like(valid)
    for axis in (depth.dim() - 1, depth.dim() - 2):
        before, before2, after, after2 = (_shifted(inverse, axis, by) for by in (-1, -2, 1, 2))
        off_plane = torch.minimum((inverse - 2 * before + before2).abs(), (inverse - 2 * after + after2).abs())
        step = torch.minimum((inverse - before).abs(), (inverse - after).abs())
        broken |= (off_plane > TOLERANCE * inverse) | (step > STEEPEST * inverse)
    near, far = _depth_range(depth, REACH)
    margin = INSIDE * (far - near)
    between = (far > (1 + CONTRAST) * near) & (depth > near + margin) & (depth < far - margin)
    return ~(broken & between)


def near_silhouettes(depth: Tensor) -> Tensor:
    """Tells the pixels on no surface, and those on a surface that breaks off within a few pixels.

    Args:
        depth: ``[..., H, W]`` z-depth in any unit, 0 = invalid.

    Returns:
        ``[..., H, W]`` bool; false where the depth is invalid.
    """
    near, far = _depth_range(depth, STEP_REACH)
    return (depth > 0) & ((far >= (1 + STEP) * near) | ~on_surface(depth))


def _depth_range(depth: Tensor, reach: int) -> tuple[Tensor, Tensor]:
    """Least and largest valid depth within ``reach`` pixels to every side, as ``depth``."""
    return -_largest(-torch.where(depth > 0, depth, torch.inf), reach), _largest(depth, reach)


def _largest(values: Tensor, reach: int) -> Tensor:
    """Largest value within ``reach`` pixels to every side; on CPUs many times as fast as ``max_pool2d``."""
    for axis in (values.dim() - 1, values.dim() - 2):
        border = [0, 0] * (values.dim() - 1 - axis) + [reach, reach]
        values, width, window = F.pad(values, border, value=-torch.inf), 1, 2 * reach + 1
        while width < window:  # largest of twice as many neighbours each time
            by = min(width, window - width)
            length = values.shape[axis] - by
            values, width = torch.maximum(values.narrow(axis, 0, length), values.narrow(axis, by, length)), width + by
    return values


def _shifted(values: Tensor, axis: int, by: int) -> Tensor:
    """``values[i + by]`` at ``i``; beyond the border the outermost value."""
    length = values.shape[axis]
    index = (torch.arange(length, device=values.device) + by).clamp(0, length - 1)
    return values.index_select(axis, index)
