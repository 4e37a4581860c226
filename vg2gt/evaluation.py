"""Numbers for one held-out scene: novel views, rendered depth and normals, decoded depth, primitives."""

from __future__ import annotations

import torch

from vg2gt.geometry.normals import normals_from_depth
from vg2gt.metrics import cv, depth_metrics, normal_metrics, psnr, ssim
from vg2gt.model import Reconstructor
from vg2gt.protocols import ground_truth_target_cameras
from vg2gt.rendering import Renderer
from vg2gt.types import Batch

CV_QUERIES = 20_000


@torch.no_grad()
def evaluate_scene(model: Reconstructor, renderer: Renderer, batch: Batch) -> dict[str, float]:
    """Reconstructs a scene from its context views and scores it on its held-out views.

    Args:
        model: the model, in any mode; it is not changed.
        renderer: its options are used in both modes.
        batch: one scene (B = 1) with held-out views.

    Returns:
        ``psnr``, ``ssim``, ``abs_rel``, ``delta_1.05``, ``coverage``, ``normal_mean`` on held-out views at ground-truth
        poses, rendered as solids whatever the training renders; ``abs_rel_rasterized`` with 3DGS rasterisation;
        ``decoded_abs_rel_before`` and ``decoded_abs_rel`` on the context views; ``gaussians``, ``cv``. Depth is
        aligned by one median scale a scene.

    Raises:
        ValueError: if the batch holds several scenes or no held-out view.
    """
    held_out = batch.images.shape[1] - batch.num_context
    if len(batch.scene) != 1 or not held_out:
        raise ValueError(f"evaluation takes one scene with held-out views, got {batch.scene} with {held_out} of them")
    prediction = model(batch.context.images, batch.context.hints)
    target = batch.target
    cameras = ground_truth_target_cameras(batch, prediction)
    rendered = renderer(prediction.gaussians, cameras, mode="solid")
    rasterized = renderer(prediction.gaussians, cameras, mode="rasterized")
    true_normals, normals_valid = normals_from_depth(target.depth, target.cameras.intrinsics)

    depth = depth_metrics(rendered.depth[0], target.depth[0], alignment="scene")
    splatted = depth_metrics(rasterized.depth[0], target.depth[0], alignment="scene")
    before = depth_metrics(prediction.initial.depth[0], batch.context.depth[0], alignment="scene")
    after = depth_metrics(prediction.geometry.depth[0], batch.context.depth[0], alignment="scene")
    normals = normal_metrics(rendered.normal[0], true_normals[0], normals_valid[0] & (rendered.depth[0] > 0))
    return {
        "psnr": float(psnr(rendered.color[0], target.images[0]).mean()),
        "ssim": float(ssim(rendered.color[0], target.images[0]).mean()),
        "abs_rel": depth["abs_rel"],
        "delta_1.05": depth["delta_1.05"],
        "coverage": depth["coverage"],
        "abs_rel_rasterized": splatted["abs_rel"],
        "normal_mean": normals["mean"],
        "decoded_abs_rel_before": before["abs_rel"],
        "decoded_abs_rel": after["abs_rel"],
        "gaussians": float(len(prediction.gaussians)),
        "cv": cv(prediction.gaussians.means, max_queries=CV_QUERIES),
    }
