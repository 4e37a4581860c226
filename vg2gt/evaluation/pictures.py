"""Pictures of scenes: inputs, renders and ground truth side by side."""

from __future__ import annotations

import torch
from torch import Tensor

from vg2gt.io.images import colorize_depth, colorize_normals, grid
from vg2gt.types import Batch, Render

ROWS = 3
PANELS = "input | rendered colour | depth | normals | ground truth"


def scene_picture(batch: Batch, rendered: Render, truth: Batch) -> Tensor:
    """Draws the panels of :data:`PANELS`, one row for each of at most three evenly spaced views.

    Args:
        batch: the scene; each row shows the input view with the frame number nearest to the rendered view's.
        rendered: rendered views of the scene.
        truth: the same views of the data.

    Returns:
        The picture, ``[3, H, W]`` in [0, 1].
    """
    count = truth.images.shape[1]
    rows = []
    for view in torch.linspace(0, count - 1, min(count, ROWS)).round().long().tolist():
        nearest = (batch.context.frame_ids[0] - truth.frame_ids[0, view]).abs().argmin()
        rows.append(panels(batch.images[0, nearest], rendered, view, truth.images[0, view]))
    return grid(rows)


def panels(image: Tensor, rendered: Render, view: int, truth: Tensor) -> list[Tensor]:
    """Returns the panels of :data:`PANELS` for one rendered view of a scene, each ``[3, H, W]``."""
    depth = rendered.depth[0, view]
    visible = depth[depth > 0]
    near, far = (float(visible.quantile(q)) for q in (0.02, 0.98)) if visible.numel() else (0.0, 1.0)
    normals = colorize_normals(rendered.normal[0, view])
    return [image, rendered.color[0, view], colorize_depth(depth, near, far), normals, truth]
