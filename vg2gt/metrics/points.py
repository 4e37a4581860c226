"""Distances between point clouds, and uniformity of a point cloud (paper, eqn junyun_cv)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

NAMES = ("accuracy", "completeness", "chamfer", "precision", "recall", "f_score")


def point_metrics(
    predicted: Tensor,
    reference: Tensor,
    threshold: float,
    downsample: float | None = None,
    cap: float | None = None,
) -> dict[str, float]:
    """Compares two point clouds in one frame and unit.

    Args:
        predicted: ``[N, 3]``.
        reference: ``[M, 3]``.
        threshold: distance below which a point counts as correct.
        downsample: edge of the cells that keep one point each, in both clouds; None keeps all points. DTU: 0.2 mm.
        cap: distances of this or more are left out of the means; None: no cap. DTU: 20 mm.

    Returns:
        ``accuracy`` (mean distance from a predicted point to the reference), ``completeness`` (the other way round),
        ``chamfer`` (the mean of both), ``precision``, ``recall`` (shares of those distances below the threshold) and
        ``f_score``, their harmonic mean; NaN if a cloud is empty or the cap leaves nothing.
    """
    first, second = (thin(cloud.detach().cpu().double().numpy(), downsample) for cloud in (predicted, reference))
    if not len(first) or not len(second):
        return dict.fromkeys(NAMES, math.nan)
    to_reference, to_predicted = KDTree(second).query(first)[0], KDTree(first).query(second)[0]
    accuracy, completeness = (_mean_below(distances, cap) for distances in (to_reference, to_predicted))
    precision, recall = (float((distances < threshold).mean()) for distances in (to_reference, to_predicted))
    both = precision + recall
    return {
        "accuracy": accuracy,
        "completeness": completeness,
        "chamfer": (accuracy + completeness) / 2,
        "precision": precision,
        "recall": recall,
        "f_score": 2 * precision * recall / both if both else 0.0,
    }


def thin(points: NDArray[np.float64], edge: float | None) -> NDArray[np.float64]:
    """Keeps the first of the points ``[N, 3]`` in each cubic cell of edge ``edge``; all points if it is None."""
    if edge is None or not len(points):
        return points
    _, first = np.unique(np.floor((points - points.min(0)) / edge), axis=0, return_index=True)
    return points[np.sort(first)]


def _mean_below(distances: NDArray[np.float64], cap: float | None) -> float:
    kept = distances if cap is None else distances[distances < cap]
    return float(kept.mean()) if len(kept) else math.nan


def cv(points: Tensor, k: int = 8, max_queries: int | None = None, seed: int = 0) -> float:
    """Coefficient of variation, std / mean, of every point's mean distance to its k nearest neighbours.

    Args:
        points: ``[N, 3]``.
        k: neighbours, the point itself not counted.
        max_queries: measure at most this many points, drawn without replacement; their neighbours are still searched
            among all points.
        seed: seed of the draw.

    Returns:
        NaN with k points or fewer, if all points coincide, or if one is not finite.
    """
    cloud = points.detach().cpu().double().numpy()
    if len(cloud) <= k or not np.isfinite(cloud).all():
        return float("nan")
    queries = cloud
    if max_queries is not None and max_queries < len(cloud):
        queries = cloud[np.random.default_rng(seed).choice(len(cloud), max_queries, replace=False)]
    distances, _ = KDTree(cloud).query(queries, k + 1)
    mean = distances[:, 1:].mean(1)
    return float(mean.std() / mean.mean()) if mean.mean() > 0 else float("nan")
