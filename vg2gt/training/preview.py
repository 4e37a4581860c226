"""The picture at the end of a run: what went in, what was rendered, what is true."""

from __future__ import annotations

from pathlib import Path

import torch
from lightning.pytorch import LightningDataModule

from vg2gt.evaluation.protocols import ground_truth_target_cameras
from vg2gt.geometry.precision import half_precision_on_gpu
from vg2gt.io.images import colorize_depth, colorize_normals, grid, write_png
from vg2gt.training.module import VG2GTModule
from vg2gt.types import Batch


@torch.no_grad()
def write_preview(module: VG2GTModule, datamodule: LightningDataModule, path: str | Path, scenes: int = 3) -> Path:
    """Writes one row a scene: input | rendered colour | depth | normals | truth, of the middle held-out view."""
    module.eval()
    rows = []
    for batch in datamodule.val_dataloader():
        for index in range(len(batch.scene)):
            rows.append(_row(module, batch.single(index).to(module.device)))
        if len(rows) >= scenes:
            break
    return write_png(path, grid(rows[:scenes]))


def _row(module: VG2GTModule, batch: Batch) -> list[torch.Tensor]:
    with half_precision_on_gpu(batch.images):
        prediction = module.model(batch.context.images, batch.context.hints)
    middle = (batch.images.shape[1] - batch.num_context) // 2
    cameras = ground_truth_target_cameras(batch, prediction).select(slice(middle, middle + 1))
    rendered = module.renderer(prediction.gaussians, cameras)
    depth = rendered.depth[0, 0]
    visible = depth[depth > 0]
    near, far = (float(visible.quantile(q)) for q in (0.02, 0.98)) if visible.numel() else (0.0, 1.0)
    return [
        batch.images[0, 0],
        rendered.color[0, 0],
        colorize_depth(depth, near, far),
        colorize_normals(rendered.normal[0, 0]),
        batch.target.images[0, middle],
    ]
