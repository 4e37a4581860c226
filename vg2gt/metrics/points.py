"""Distances between point clouds, and uniformity of a point cloud (paper, eqn junyun_cv)."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from vg2gt.kernels.knn import nearest_in_scenes

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
    first, second = (thin(cloud.detach(), downsample) for cloud in (predicted, reference))
    if not len(first) or not len(second):
        return dict.fromkeys(NAMES, math.nan)
    both_ways = [_nearest_distances(first, second, 1), _nearest_distances(second, first, 1)]
    accuracy, completeness = (_mean_below(distances, cap) for distances in both_ways)
    precision, recall = (float((distances < threshold).double().mean()) for distances in both_ways)
    both = precision + recall
    return {
        "accuracy": accuracy,
        "completeness": completeness,
        "chamfer": (accuracy + completeness) / 2,
        "precision": precision,
        "recall": recall,
        "f_score": 2 * precision * recall / both if both else 0.0,
    }


def thin(points: Tensor, edge: float | None) -> Tensor:
    """Keeps the first of the points ``[N, 3]`` in each cubic cell of edge ``edge``; all points if it is None."""
    if edge is None or not len(points):
        return points
    exact = points.double()
    rows = torch.arange(len(points), device=points.device)
    cell = torch.zeros_like(rows)  # numbers of the cells that have points; axis by axis, so that products stay small
    for axis in ((exact - exact.amin(0)) / edge).floor().unbind(1):
        number = torch.unique(axis, return_inverse=True)[1]
        cell = torch.unique(cell * len(points) + number, return_inverse=True)[1]
    first = torch.full((int(cell.max()) + 1,), len(points), device=points.device).scatter_reduce_(0, cell, rows, "amin")
    return points[first.sort().values]


def _nearest_distances(queries: Tensor, points: Tensor, count: int) -> Tensor:
    """Distances ``[N, count]`` in float64 from queries to their nearest points, nearest first, on their device.

    They are found in float32, which the compiled search on a CPU takes; of two closer than its rounding, either one.
    """
    scenes = [torch.zeros(len(cloud), dtype=torch.int64, device=cloud.device) for cloud in (queries, points)]
    index, _ = nearest_in_scenes(queries.float(), scenes[0], points.float(), scenes[1], count, 1)
    return (queries.double()[:, None] - points.double()[index]).norm(dim=-1)


def _mean_below(distances: Tensor, cap: float | None) -> float:
    return float((distances if cap is None else distances[distances < cap]).mean())  # NaN without any


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
    cloud = points.detach()
    if len(cloud) <= k or not bool(cloud.isfinite().all()):
        return math.nan
    queries = cloud
    if max_queries is not None and max_queries < len(cloud):
        drawn = np.random.default_rng(seed).choice(len(cloud), max_queries, replace=False)
        queries = cloud[torch.from_numpy(drawn).to(cloud.device)]
    mean = _nearest_distances(queries, cloud, k + 1)[:, 1:].mean(1)
    spread, size = float(mean.std(correction=0)), float(mean.mean())
    return spread / size if size > 0 else math.nan
