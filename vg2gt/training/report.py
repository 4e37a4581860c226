"""Final report of a run: a table comparing the untrained with the trained head, and a preview image."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from lightning.pytorch import LightningDataModule

from vg2gt.evaluation.pictures import panels
from vg2gt.evaluation.protocols import ground_truth_target_cameras
from vg2gt.evaluation.tables import columns, markdown_table, number
from vg2gt.geometry.precision import half_precision_on_gpu
from vg2gt.io.images import grid, write_png
from vg2gt.training.module import VG2GTModule
from vg2gt.types import Batch

ROWS = columns(
    *("psnr", "ssim", "abs_rel", "delta_1.05", "normal_mean", "coverage"),
    *("decoded_abs_rel_before", "decoded_abs_rel", "gaussians", "cv"),
    labels={
        "abs_rel": "rendered depth abs_rel",
        "delta_1.05": "rendered depth delta < 1.05",
        "normal_mean": "rendered normals, mean angle [deg]",
        "coverage": "share of pixels with a depth",
        "decoded_abs_rel_before": "decoded depth abs_rel, backbone",
        "decoded_abs_rel": "decoded depth abs_rel, enhanced",
        "cv": "uniformity CV (k = 8)",
    },
)
_HEAD = ("", "untrained", "trained", "change")
_PREVIEWED = 3  # maximum number of scenes in the preview
_CAPTION = "views never trained on, at ground-truth poses; depth aligned by one median scale per scene"


def comparison_table(untrained: dict[str, float], trained: dict[str, float]) -> str:
    """Returns the table as Markdown."""
    rows = []
    for name, metric in ROWS.items():
        before, after = untrained.get(name, math.nan), trained.get(name, math.nan)
        change = after - before
        relative = f" ({change / before:+.0%})" if before and math.isfinite(change) else ""
        shown = [number(before, metric.decimals), number(after, metric.decimals)]
        rows.append([metric.label, *shown, number(change, metric.decimals, sign=True) + relative])
    return f"{markdown_table(_HEAD, rows)}\n\n{_CAPTION}.\n"


@torch.no_grad()
def write_preview(module: VG2GTModule, datamodule: LightningDataModule, path: str | Path) -> Path:
    """Writes one row per scene: an input, then the middle held-out view's rendered colour, depth, normals, and truth.

    Args:
        module: the trained module.
        datamodule: provides the evaluation scenes.
        path: PNG file to write.

    Returns:
        The path written.
    """
    module.eval()
    rows = []
    for batch in datamodule.val_dataloader():
        for index in range(len(batch.scene)):
            rows.append(_row(module, batch.single(index).to(module.device)))
        if len(rows) >= _PREVIEWED:
            break
    return write_png(path, grid(rows[:_PREVIEWED]))


def _row(module: VG2GTModule, batch: Batch) -> list[torch.Tensor]:
    with half_precision_on_gpu(batch.images):
        prediction = module.model(batch.context.images, batch.context.hints)
    middle = (batch.images.shape[1] - batch.num_context) // 2
    cameras = ground_truth_target_cameras(batch, prediction).select(slice(middle, middle + 1))
    rendered = module.renderer(prediction.gaussians, cameras)
    return panels(batch.images[0, 0], rendered, 0, batch.target.images[0, middle])
