"""Evaluation of one scene during training."""

from __future__ import annotations

import logging
from typing import Any

import torch

from vg2gt.evaluation.protocols import ground_truth_target_cameras
from vg2gt.evaluation.scene_metrics import (
    edge_metrics,
    image_metrics,
    rendered_normal_metrics,
)
from vg2gt.geometry.precision import full_precision
from vg2gt.metrics import cv, depth_metrics
from vg2gt.model import Reconstructor
from vg2gt.rendering import Renderer, UnrenderableError
from vg2gt.types import Batch, Cameras, Gaussians, Render

log = logging.getLogger(__name__)

CV_QUERIES = 20_000


@torch.no_grad()
def evaluate_scene(
    model: Reconstructor, renderer: Renderer, batch: Batch, rasterized: bool = False
) -> dict[str, float]:
    """Reconstructs one scene (B = 1) from its context views and scores its held-out views.

    Args:
        model: in any mode; not changed.
        renderer: renderer whose options apply to both modes.
        batch: one scene with held-out views.
        rasterized: also score the depth of 3DGS rasterisation (``abs_rel_rasterized``).

    Returns:
        Metrics of the held-out views at true poses, rendered as stochastic solids (``psnr``, ``abs_rel``, ...), and of
        the context views' decoded depth before and after enhancement; ``gaussians`` and ``cv``. Depth is aligned by
        one scale per scene.

    Raises:
        ValueError: if the batch holds several scenes or no held-out view.
    """
    held_out = batch.images.shape[1] - batch.num_context
    if len(batch.scene) != 1 or not held_out:
        raise ValueError(f"evaluation takes one scene with held-out views, got {batch.scene} with {held_out} of them")
    prediction = model(batch.context.images, batch.context.hints)
    target = batch.target

    def abs_rel(found: torch.Tensor, truth: Batch) -> float:
        return depth_metrics(found[0], truth.depth[0], "scene")["abs_rel"]

    with full_precision(batch.images):
        cameras = ground_truth_target_cameras(batch, prediction)
        rendered = render_or_nan(renderer, prediction.gaussians, cameras, "solid")
        depth = depth_metrics(rendered.depth[0], target.depth[0], "scene")
        metrics = {
            **image_metrics(rendered, target),
            **{name: depth[name] for name in ("rmse", "abs_rel", "delta_1.25", "delta_1.05", "coverage")},
            "normal_mean": rendered_normal_metrics(rendered, target)["normal_mean"],
            "decoded_abs_rel_before": abs_rel(prediction.initial.depth, batch.context),
            "decoded_abs_rel": abs_rel(prediction.geometry.depth, batch.context),
            **edge_metrics(rendered, target, "scene"),
            "gaussians": float(len(prediction.gaussians)),
            "cv": cv(prediction.gaussians.means, max_queries=CV_QUERIES),
        }
        if rasterized:
            flat = render_or_nan(renderer, prediction.gaussians, cameras, "rasterized")
            metrics["abs_rel_rasterized"] = abs_rel(flat.depth, target)
    return metrics


def render_or_nan(renderer: Renderer, gaussians: Gaussians, cameras: Cameras, mode: Any) -> Render:
    """Renders views; if nothing can be rendered, logs a warning and returns NaN views, which reports show as n/a."""
    try:
        return renderer(gaussians, cameras, mode=mode)
    except UnrenderableError as error:
        log.warning("a scene has nothing to render: %s", error)
    views = cameras.world_to_camera.shape[:2]
    flat = gaussians.means.new_full((*views, *cameras.size), torch.nan)
    three = flat[:, :, None].expand(-1, -1, 3, -1, -1)
    return Render(color=three, depth=flat, normal=three, alpha=flat)
