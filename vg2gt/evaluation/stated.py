"""Stated errors of decoded depth against true ones."""

from __future__ import annotations

import torch
from torch import Tensor

from vg2gt.metrics import stated_error_metrics
from vg2gt.types import Batch, Decoded
from vg2gt.uncertainty import LEVELS, Calibration, Samples, pixel_evidence


def stated_metrics(
    calibration: Calibration, decoded: Decoded, keep: Tensor | None, truth: Batch, predicts_cameras: bool
) -> dict[str, float]:
    """Scores what a calibration states of the decoded depth of one scene (:func:`vg2gt.metrics.stated_error_metrics`).

    Args:
        calibration: of the model.
        decoded: of one scene (B = 1).
        keep: ``[1, V, H, W]`` bool, pixels that the scene is made of; None: all that have a depth.
        truth: its context views.
        predicts_cameras: see :func:`pixels_with_errors`.
    """
    pixels = pixels_with_errors(decoded, keep, truth, predicts_cameras)
    return stated_error_metrics(pixels.error, calibration.bounds(pixels.evidence, pixels.status), LEVELS)


def pixels_with_errors(
    decoded: Decoded, keep: Tensor | None, truth: Batch, predicts_cameras: bool, scene: int = 0
) -> Samples:
    """The pixels of one scene whose depth is decoded and known, with evidence and true error.

    Args:
        decoded: of one scene (B = 1).
        keep: ``[1, V, H, W]`` bool, pixels that the scene is made of; None: all that have a depth.
        truth: its context views.
        predicts_cameras: whether the unit is the backbone's own, so that one factor (the median) is taken out of the
            scene's depth first; cameras that are given fix it.
        scene: what the samples say they are of.
    """
    depth, true = decoded.geometry.depth[0].float(), truth.depth[0].float()
    evidence, status = pixel_evidence(decoded.geometry, keep)
    rows = (depth > 0) & (true > 0) & true.isfinite()
    ratio = true[rows] / depth[rows]
    ratio = ratio / ratio.median() if predicts_cameras and len(ratio) else ratio * decoded.unit[0]
    error = (ratio - 1).abs()
    return Samples(evidence[rows], status[rows], error, torch.full_like(error, scene, dtype=torch.int64)).to("cpu")
