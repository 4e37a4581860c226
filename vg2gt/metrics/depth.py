"""Errors of depth after alignment (paper, eq_delta_n) and of normals, and depth edges."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.geometry.alignment import MIN_DEPTH, weighted_median
from vg2gt.types import check_choice

ALIGNMENTS = ("median", "scene", "wmed", "scale_shift", "none")
_DELTAS = (1.25, 1.05, 1.03)
NAMES = ("abs_rel", "mae", "rmse", *(f"delta_{d}" for d in _DELTAS), "coverage", *(f"delta_{d}_holes" for d in _DELTAS))
SMALLEST = 1e-6
_EDGE = 0.05  # relative step of depth between neighbouring pixels

_NORMAL_ACCURACIES = (10, 30)  # degrees
_NORMAL_NAMES = ("mean", "median", *(f"acc_{a}" for a in _NORMAL_ACCURACIES), "cosine")


def depth_metrics(
    predicted: Tensor, reference: Tensor, alignment: str = "median", region: Tensor | None = None
) -> dict[str, float]:
    """Scores the depth maps of one scene: pixels are averaged per image, images per scene.

    A pixel counts where the reference is valid and the prediction has a depth.

    Args:
        predicted: ``[V, H, W]`` z-depth, 0 = hole.
        reference: ``[V, H, W]`` true z-depth, 0 = invalid.
        alignment: ``median``: one median ratio per image; ``scene``: one median ratio per scene; ``wmed``: the ratio
            per image that minimises the relative L1 error; ``scale_shift``: least squares per image; ``none``.
        region: ``[V, H, W]`` bool, pixels to score; the alignment uses all pixels regardless. None scores all.

    Returns:
        ``abs_rel``, ``mae``, ``rmse`` (in the reference's unit), ``delta_1.25``, ``delta_1.05``, ``delta_1.03`` over
        the pixels that count; ``coverage``, the share of usable reference pixels that have a depth; ``delta_*_holes``,
        in which holes count as failures. Images without usable pixels are left out; NaN if none remain.

    Raises:
        ValueError: if the alignment is unknown.
    """
    check_choice("evaluation.alignment", alignment, ALIGNMENTS)
    predicted, reference = predicted.double(), reference.double()
    usable = (reference > 0) & reference.isfinite()
    valid = usable & (predicted > 0) & predicted.isfinite()
    if alignment == "scene":
        alignment = "none"
        if valid.any():
            predicted = predicted * (reference[valid] / predicted[valid]).median()
    region = torch.ones_like(usable) if region is None else region
    images = [
        _score(_aligned(p[v], r[v], alignment)[s[v]], r[v & s], (v & s).sum().double() / (u & s).sum())
        for p, r, u, v, s in zip(predicted, reference, usable, valid, region, strict=True)
        if (u & s).any()
    ]
    return {name: float(torch.stack([i[name] for i in images]).nanmean()) if images else math.nan for name in NAMES}


def _aligned(predicted: Tensor, reference: Tensor, alignment: str) -> Tensor:
    """Aligns the depths ``[N]`` of one image to their references ``[N]``; see :func:`depth_metrics`."""
    if alignment in ("none", "scene") or not len(predicted):
        return predicted
    if alignment == "median":
        return predicted * (reference / predicted).median()
    if alignment == "wmed":
        return predicted * weighted_median(reference / predicted, predicted / reference.clamp(min=MIN_DEPTH))
    centered = predicted - predicted.mean()
    variance = centered.square().sum()
    scale = (centered * reference).sum() / variance if variance > 0 else torch.ones_like(variance)
    return (reference.mean() + scale * centered).clamp(min=SMALLEST)


def _score(predicted: Tensor, reference: Tensor, coverage: Tensor) -> dict[str, Tensor]:
    error = (predicted - reference).abs()
    ratio = torch.maximum(predicted / reference, reference / predicted)
    results = {
        "abs_rel": (error / reference).mean(),
        "mae": error.mean(),
        "rmse": error.square().mean().sqrt(),
        "coverage": coverage,
    }
    for delta in _DELTAS:
        share = (ratio < delta).double().mean()
        results[f"delta_{delta}"] = share
        results[f"delta_{delta}_holes"] = share.nan_to_num(0.0) * coverage
    return results


def normal_metrics(predicted: Tensor, reference: Tensor, valid: Tensor) -> dict[str, float]:
    """Scores the normal maps of one scene: pixels are averaged per image, images per scene.

    Args:
        predicted: ``[V, 3, H, W]``, any length; pixels of length 0 are left out.
        reference: ``[V, 3, H, W]`` in the same frame, any length.
        valid: ``[V, H, W]`` bool.

    Returns:
        ``mean`` and ``median`` angle in degrees, ``acc_10`` and ``acc_30`` (shares of pixels below that many degrees),
        ``cosine``; NaN without valid pixels.
    """
    predicted, reference = predicted.double(), reference.double()
    lengths = predicted.norm(dim=1) * reference.norm(dim=1)
    valid = valid & (lengths > 0)
    dot = (predicted * reference).sum(1)
    cosine = dot / torch.where(valid, lengths, 1.0)
    # atan2 keeps its precision at small angles, where acos has none.
    angle = torch.atan2(torch.linalg.cross(predicted, reference, dim=1).norm(dim=1), dot).rad2deg()
    images = []
    for a, c in ((a[v], c[v]) for a, c, v in zip(angle, cosine, valid, strict=True) if v.any()):
        shares = [(a < limit).double().mean() for limit in _NORMAL_ACCURACIES]
        images.append(torch.stack((a.mean(), a.median(), *shares, c.mean())))
    means = torch.stack(images).mean(0).tolist() if images else [math.nan] * len(_NORMAL_NAMES)
    return dict(zip(_NORMAL_NAMES, means, strict=True))


def near_depth_edges(depth: Tensor) -> Tensor:
    """Marks the pixels of depth ``[..., H, W]`` at most 3 pixels (along either axis) from a relative step over 5 %.

    Steps to invalid pixels (depth 0) are no edges.
    """
    edges = torch.zeros_like(depth, dtype=torch.bool)
    for axis in (-1, -2):
        count = depth.shape[axis] - 1
        first, second = depth.narrow(axis, 0, count), depth.narrow(axis, 1, count)
        nearer = torch.minimum(first, second)
        broken = (nearer > 0) & ((first - second).abs() > _EDGE * nearer)
        edges.narrow(axis, 0, count).logical_or_(broken)
        edges.narrow(axis, 1, count).logical_or_(broken)
    flat = edges.to(torch.float32).flatten(0, -3)[:, None]  # [N, 1, H, W]
    # A pixel next to an edge is half a pixel from it: two more steps reach the distance.
    return (F.max_pool2d(flat, 5, 1, 2) > 0).reshape(depth.shape)
