"""Metrics of rendered and decoded views against ground truth."""

from __future__ import annotations

import torch
from torch import Tensor

from vg2gt.geometry.alignment import Similarity, align_points
from vg2gt.geometry.cameras import unproject
from vg2gt.geometry.normals import normals_from_depth
from vg2gt.metrics import (
    LPIPS,
    depth_metrics,
    near_depth_edges,
    normal_metrics,
    point_metrics,
    psnr,
    ssim,
)
from vg2gt.types import Batch, Cameras, Decoded, Geometry, Render
from vg2gt.uncertainty import LEVELS, MEASURED, STATED, Samples
from vg2gt.visibility import pixel_evidence

SHARES = 20  # steps of the sparsification curve


def image_metrics(rendered: Render, truth: Batch, lpips: LPIPS | None = None) -> dict[str, float]:
    """``psnr``, ``ssim`` and, if a network is given, ``lpips`` of one scene, averaged over its views.

    Masked pixels count as correct, as in the loss; views without any other pixel do not count.
    """
    images, color = truth.images[0], rendered.color[0]
    if truth.mask is not None:
        counts = truth.mask[0].flatten(1).any(1)  # [V]
        if not counts.any():
            return {}
        color = torch.lerp(images, color, truth.mask[0, :, None])[counts]
        images = images[counts]
    found = {"psnr": float(psnr(color, images).mean()), "ssim": float(ssim(color, images).mean())}
    if lpips is not None:
        found["lpips"] = float(lpips(color, images).mean())
    return found


def rendered_normal_metrics(rendered: Render, truth: Batch) -> dict[str, float]:
    """Errors of the rendered normals of one scene; the names have the prefix ``normal_``.

    Pixels count where a depth was rendered and the true depth has a normal (valid neighbours, no depth edge).
    """
    normals, valid = normals_from_depth(truth.depth, truth.cameras.intrinsics)
    found = normal_metrics(rendered.normal[0], normals[0], valid[0] & (rendered.depth[0] > 0))
    return {f"normal_{name}": value for name, value in found.items()}


def edge_metrics(rendered: Render, truth: Batch, alignment: str) -> dict[str, float]:
    """``edge_psnr`` and ``edge_abs_rel`` of one scene, within 3 pixels of true depth edges; NaN if there are none."""
    region = near_depth_edges(truth.depth)
    if truth.mask is not None:
        region &= truth.mask > 0
    depth = depth_metrics(rendered.depth[0], truth.depth[0], alignment, region=region[0])
    error = (rendered.color.clamp(0, 1) - truth.images.clamp(0, 1)).double().square().mean(2)[0]  # [V, H, W]
    per_view = [e[r].mean() for e, r in zip(error, region[0], strict=True) if r.any()]
    psnr = -10 * torch.stack(per_view).log10().mean() if per_view else torch.nan
    return {"edge_psnr": float(psnr), "edge_abs_rel": depth["abs_rel"]}


def point_cloud_metrics(
    depth: Tensor, cameras: Cameras, truth: Batch, similarity: Similarity, **options: float | None
) -> dict[str, float]:
    """Compares the points of predicted depth maps with the true points, at pixels with known true depth.

    Args:
        depth: ``[1, V, H, W]``.
        cameras: predicted cameras of the same views.
        truth: the same views.
        similarity: transform from the predicted to the true world frame.
        options: keyword arguments of :func:`vg2gt.metrics.point_metrics`.
    """
    known = truth.depth > 0
    predicted = similarity.apply(unproject(depth, cameras))[known & (depth > 0) & depth.isfinite()]
    predicted = predicted[predicted.isfinite().all(-1)]
    reference = unproject(truth.depth, truth.cameras)[known]
    return point_metrics(predicted, reference, **options)  # pyright: ignore[reportArgumentType]


def align_geometry(geometry: Geometry, truth: Batch) -> Similarity | None:
    """Fits a similarity transform from decoded to true points of the same pixels; None with fewer than 3 points.

    Points are used instead of cameras: a scale estimated from a short baseline would displace the whole cloud.
    """
    valid = (geometry.depth > 0) & geometry.depth.isfinite() & (truth.depth > 0)
    if int(valid.sum()) < 3:
        return None
    predicted, reference = unproject(geometry.depth, geometry.cameras), unproject(truth.depth, truth.cameras)
    return align_points(predicted[valid][None], reference[valid][None])


def stated_error_metrics(error: Tensor, bounds: Tensor, status: Tensor) -> dict[str, float]:
    """Scores stated bounds of errors: how often they hold, how wide they are, and how well they rank errors.

    Args:
        error: ``[N]`` errors >= 0 (:mod:`vg2gt.uncertainty.calibration`).
        bounds: ``[L, N]`` stated upper bounds of the errors, for each of :data:`vg2gt.uncertainty.LEVELS`.
        status: ``[N]`` :class:`vg2gt.visibility.Status` of the pixels.

    Returns:
        For each level, ``held_90``, the share of errors within the bound, and ``width_90``, the median bound;
        ``held_90_agreed`` and so on, the share for the pixels of each status with a depth, at the level of the stated
        error; and ``ause``, :func:`ause` of the last level's bound. NaN without pixels.
    """
    scores: dict[str, float] = {}
    for level, bound in zip(LEVELS, bounds, strict=True):
        name, held = f"{100 * level:.0f}", (error <= bound).double()
        scores[f"held_{name}"] = float(held.mean())
        scores[f"width_{name}"] = float(bound.median()) if len(bound) else float("nan")
        if level == STATED:
            for kind in MEASURED:
                scores[f"held_{name}_{kind.name.lower()}"] = float(held[status == kind].mean())
    return scores | {"ause": ause(error, bounds[-1])}


def ause(error: Tensor, stated: Tensor) -> float:
    """Area under the sparsification error (Ilg et al., Uncertainty Estimates for Optical Flow, 2018).

    Removes pixels step by step, once by largest stated and once by largest true error. The area between the two curves
    of the remaining mean error is given relative to the mean error of all pixels; 0 means a perfect ranking.

    Args:
        error: ``[N]`` true errors >= 0.
        stated: ``[N]`` stated errors, which rank the pixels.
    """
    if not len(error):
        return float("nan")
    left = torch.tensor([max(1, round(len(error) * (1 - step / SHARES))) for step in range(SHARES)])

    def curve(order: Tensor) -> Tensor:
        """Returns the mean error of the first ``left`` pixels, relative to that of all."""
        return error[order].double().cumsum(0)[left - 1] / left / mean

    mean = error.double().mean().clamp(min=1e-12)
    return float((curve(stated.argsort(stable=True)) - curve(error.argsort(stable=True))).mean())


def pixels_with_errors(
    decoded: Decoded, keep: Tensor | None, truth: Batch, predicts_cameras: bool, scene: int = 0
) -> Samples:
    """Collects the pixels of one scene that have decoded and true depth, with their evidence and true error.

    Args:
        decoded: decoded geometry of one scene (B = 1).
        keep: ``[1, V, H, W]`` bool, pixels that the scene is made of; None: all with a depth.
        truth: context views of the scene.
        predicts_cameras: whether the backbone predicts the cameras and thus the unit. If so, the median ratio to the
            true depth is divided out first; given cameras fix the unit.
        scene: scene number stored in the samples.
    """
    depth, true = decoded.geometry.depth[0].float(), truth.depth[0].float()
    evidence, status = pixel_evidence(decoded.geometry, keep)
    rows = (depth > 0) & (true > 0) & true.isfinite()
    ratio = true[rows] / depth[rows]
    ratio = ratio / ratio.median() if predicts_cameras and len(ratio) else ratio * decoded.unit[0]
    error = ratio.log().abs().expm1()
    return Samples(evidence[rows], status[rows], error, torch.full_like(error, scene, dtype=torch.int64)).to("cpu")
