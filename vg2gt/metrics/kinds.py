"""Kinds of pixels, to report depth errors by what makes depth hard."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.geometry.cameras import project, unproject
from vg2gt.metrics.depth import near_depth_edges
from vg2gt.types import Cameras

KINDS = ("alone", "edge", "bare", "weak", "textured")
_WEAK, _TEXTURED = 0.012, 0.03  # least deviation of grey of weak and of clear texture
_SAME = 0.05  # relative difference of depth up to which two views see the same surface


def pixel_kinds(images: Tensor, depth: Tensor, cameras: Cameras) -> dict[str, Tensor]:
    """Sorts the pixels of one scene by whether other views see them, and by texture.

    Args:
        images: ``[V, 3, H, W]`` in [0, 1], H and W at least 7.
        depth: ground-truth z-depth ``[V, H, W]``; 0 and infinity are unknown.
        cameras: cameras of one scene, ``[1, V]``.

    Returns:
        Masks ``[V, H, W]`` by name. Every pixel of known depth is in exactly one: ``alone``, no other view sees its
        surface (the same depth within 5 %); ``edge``, see :func:`near_depth_edges`; else by the standard deviation of
        grey within 7x7 pixels, ``bare`` below 0.012, ``weak`` below 0.03, ``textured`` from there on.
    """
    valid = (depth > 0) & depth.isfinite()
    alone = ~_seen_by_others(torch.where(valid, depth, 0.0), cameras)
    edge = near_depth_edges(depth)
    grey = F.pad(images.mean(1, keepdim=True), (3, 3, 3, 3), mode="reflect")
    variance = F.avg_pool2d(grey**2, 7, 1) - F.avg_pool2d(grey, 7, 1) ** 2
    deviation = variance[:, 0].clamp_min(0).sqrt()  # [V, H, W]
    smooth = valid & ~alone & ~edge
    bare, textured = deviation < _WEAK, deviation >= _TEXTURED
    masks = (valid & alone, valid & ~alone & edge, smooth & bare, smooth & ~bare & ~textured, smooth & textured)
    return dict(zip(KINDS, masks, strict=True))


def _seen_by_others(depth: Tensor, cameras: Cameras) -> Tensor:
    """Marks the pixels ``[V, H, W]`` whose point has the depth that another view has where it projects to."""
    views, height, width = depth.shape
    points = unproject(depth[None], cameras)[0]  # [V, H, W, 3]
    seen = torch.zeros_like(depth, dtype=torch.bool)
    for view in range(views):
        pixels, z = project(points[None], cameras.select(torch.full((views,), view)))
        column, row = pixels[0].nan_to_num(-1, -1, -1).round().long().unbind(-1)
        inside = (z[0] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        there = depth[view, row.clamp(0, height - 1), column.clamp(0, width - 1)]
        same = inside & (depth > 0) & ((there - z[0]).abs() < _SAME * z[0])
        same[view] = False
        seen |= same
    return seen
