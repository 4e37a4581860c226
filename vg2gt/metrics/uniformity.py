"""Spatial uniformity of a point cloud (paper, eqn junyun_cv)."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree
from torch import Tensor


def cv(points: Tensor, k: int = 8, max_queries: int | None = None, seed: int = 0) -> float:
    """Coefficient of variation, std / mean, of every point's mean distance to its k nearest neighbours.

    Args:
        points: ``[N, 3]``.
        k: neighbours, the point itself not counted.
        max_queries: measure at most this many points, drawn without replacement; their neighbours are still searched
            among all points.
        seed: of that draw.

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
