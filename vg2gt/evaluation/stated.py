"""Calibrated error bounds of decoded depth, compared with the true errors."""

from __future__ import annotations

import torch
from torch import Tensor

from vg2gt.metrics import stated_error_metrics
from vg2gt.types import Batch, Decoded
from vg2gt.uncertainty import LEVELS, Calibration, Samples, pixel_evidence


def stated_metrics(
    calibration: Calibration, decoded: Decoded, keep: Tensor | None, truth: Batch, predicts_cameras: bool
) -> dict[str, float]:
    """Scores the error bounds of one scene's decoded depth (:func:`vg2gt.metrics.stated_error_metrics`).

    Args:
        calibration: calibration of the model.
        decoded: decoded geometry of one scene (B = 1).
        keep: ``[1, V, H, W]`` bool, pixels that the scene is made of; None: all with a depth.
        truth: context views of the scene.
        predicts_cameras: see :func:`pixels_with_errors`.
    """
    pixels = pixels_with_errors(decoded, keep, truth, predicts_cameras)
    return stated_error_metrics(pixels.error, calibration.bounds(pixels.evidence, pixels.status), LEVELS)


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
    error = (ratio - 1).abs()
    return Samples(evidence[rows], status[rows], error, torch.full_like(error, scene, dtype=torch.int64)).to("cpu")
