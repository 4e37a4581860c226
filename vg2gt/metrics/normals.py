"""Angles between normal maps."""

from __future__ import annotations

import math

import torch
from torch import Tensor

ACCURACIES = (10, 30)
NAMES = ("mean", "median", *(f"acc_{a}" for a in ACCURACIES), "cosine")


def normal_metrics(predicted: Tensor, reference: Tensor, valid: Tensor) -> dict[str, float]:
    """Scores the normal maps of one scene: pixels are averaged per image, images per scene.

    Args:
        predicted: ``[V, 3, H, W]``, any length; pixels of length 0 are left out.
        reference: ``[V, 3, H, W]`` in the same frame, any length.
        valid: ``[V, H, W]`` bool.

    Returns:
        ``mean`` and ``median`` angle in degrees, ``acc_10`` and ``acc_30`` (shares of pixels below that many degrees),
        ``cosine``; NaN without valid pixels.

    Raises:
        ValueError: if the shapes do not match.
    """
    if predicted.shape != reference.shape or predicted.shape[:1] + predicted.shape[2:] != valid.shape:
        raise ValueError(
            f"normals must be [V, 3, H, W] and valid [V, H, W], got {tuple(predicted.shape)}, {tuple(reference.shape)} "
            f"and {tuple(valid.shape)}"
        )
    predicted, reference = predicted.double(), reference.double()
    lengths = predicted.norm(dim=1) * reference.norm(dim=1)
    valid = valid & (lengths > 0)
    dot = (predicted * reference).sum(1)
    cosine = dot / torch.where(valid, lengths, 1.0)
    # atan2 keeps its precision at small angles, where acos has none.
    angle = torch.atan2(torch.linalg.cross(predicted, reference, dim=1).norm(dim=1), dot).rad2deg()
    images = [_image(a[v], c[v]) for a, c, v in zip(angle, cosine, valid, strict=True) if v.any()]
    return {name: float(torch.stack([i[name] for i in images]).mean()) if images else math.nan for name in NAMES}


def _image(angle: Tensor, cosine: Tensor) -> dict[str, Tensor]:
    results = {"mean": angle.mean(), "median": angle.median(), "cosine": cosine.mean()}
    return results | {f"acc_{a}": (angle < a).double().mean() for a in ACCURACIES}
