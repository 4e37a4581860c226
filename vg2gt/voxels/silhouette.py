"""Points between foreground and background, which lie on no surface (our addition to the paper's fine level).

Decoded depth does not break off at a silhouette, it runs from the foreground to the background within a few pixels.
Unprojected and put into voxels those pixels become the fringe of splinters that surrounds every object.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

TOLERANCE = 0.015  # relative, of a pixel's depth to the plane through two neighbours on the same side
STEEPEST = 0.12  # relative change of depth from pixel to pixel beyond which even a plane says nothing
CONTRAST = 0.08  # relative range of depth in a window without which there is no silhouette
INSIDE = 0.05  # share of that range by which a pixel lies behind the front and before the back
WINDOW = 5  # pixels


def on_surface(depth: Tensor) -> Tensor:
    """Tells the pixels of a surface from those between foreground and background.

    Inverse depth is linear in the image of a plane, so a surface's pixel lies on the line through its two neighbours to
    the left or on that through those to the right, and likewise up or down. A pixel that fails this along either axis,
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
    maps = depth.flatten(0, -3)[:, None]  # [N, 1, H, W]
    far = F.max_pool2d(maps, WINDOW, 1, WINDOW // 2).reshape(depth.shape)
    near = -F.max_pool2d(-torch.where(maps > 0, maps, torch.inf), WINDOW, 1, WINDOW // 2).reshape(depth.shape)
    margin = INSIDE * (far - near)
    between = (far > (1 + CONTRAST) * near) & (depth > near + margin) & (depth < far - margin)
    return ~(broken & between)


def _shifted(values: Tensor, axis: int, by: int) -> Tensor:
    """``values[i + by]`` at ``i``; beyond the border the outermost value."""
    length = values.shape[axis]
    index = (torch.arange(length, device=values.device) + by).clamp(0, length - 1)
    return values.index_select(axis, index)
