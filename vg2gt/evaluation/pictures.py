"""Qualitative grids of inputs, renders, ground truth and depth errors."""

from __future__ import annotations

import torch
from torch import Tensor

from vg2gt.geometry.normals import normals_from_depth
from vg2gt.io.images import colorize_depth, colorize_normals, grid
from vg2gt.metrics.depth import align_depth
from vg2gt.types import Batch, Render

ROWS = 3
LARGEST_ERROR = 0.1
PANELS = "input | rendered | truth | rendered depth | true depth | depth error | rendered normals | true normals"


def scene_picture(batch: Batch, rendered: Render, truth: Batch, alignment: str) -> Tensor:
    """Draws the panels of :data:`PANELS`, one row for each of at most three evenly spaced views.

    Args:
        batch: the scene; each row shows the input view with the frame number nearest to the rendered view's.
        rendered: rendered views of the scene.
        truth: the same views of the data.
        alignment: alignment of the rendered depth, per image; ``scene`` is treated as ``median``.

    Returns:
        The picture, ``[3, H, W]`` in [0, 1].
    """
    count = truth.images.shape[1]
    views = torch.linspace(0, count - 1, min(count, ROWS)).round().long().tolist()
    normals, _ = normals_from_depth(truth.depth, truth.cameras.intrinsics)
    rows = []
    for view in views:
        nearest = (batch.context.frame_ids[0] - truth.frame_ids[0, view]).abs().argmin()
        true_depth, depth = truth.depth[0, view].float(), rendered.depth[0, view].float()
        depth = _aligned(depth, true_depth, "median" if alignment == "scene" else alignment)
        near, far = _range(true_depth if (true_depth > 0).any() else depth)
        rows.append(
            [
                batch.images[0, nearest],
                rendered.color[0, view],
                truth.images[0, view],
                colorize_depth(depth, near, far),
                colorize_depth(true_depth, near, far),
                colorize_error(depth, true_depth),
                colorize_normals(rendered.normal[0, view]),
                colorize_normals(normals[0, view]),
            ]
        )
    return grid(rows)


def colorize_error(depth: Tensor, reference: Tensor) -> Tensor:
    """Colours relative errors ``[H, W]`` of aligned depth: 0 white, 5 % red, 10 % black; holes blue, unknown grey."""
    known = reference > 0
    error = (depth - reference).abs() / torch.where(known, reference, 1.0) / LARGEST_ERROR
    red = (2 - 2 * error).clamp(0, 1)
    others = (1 - 2 * error).clamp(0, 1)
    colors = torch.stack((red, others, others))
    colors = torch.where(depth > 0, colors, colors.new_tensor([0.1, 0.3, 0.9])[:, None, None])
    return torch.where(known, colors, 0.6)


def _aligned(depth: Tensor, reference: Tensor, alignment: str) -> Tensor:
    valid = (depth > 0) & (reference > 0)
    if alignment == "none" or not valid.any():
        return depth
    if alignment == "scale_shift":
        aligned = torch.zeros_like(depth)
        aligned[valid] = align_depth(depth[valid], reference[valid], alignment)
        return aligned
    scale = align_depth(depth[valid], reference[valid], alignment)[0] / depth[valid][0]
    return depth * scale


def _range(depth: Tensor) -> tuple[float, float]:
    visible = depth[depth > 0]
    if not visible.numel():
        return 0.0, 1.0
    low, high = visible.sort().values[[int(q * (visible.numel() - 1)) for q in (0.02, 0.98)]].tolist()
    return low, high
