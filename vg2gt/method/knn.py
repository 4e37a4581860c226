"""Nearest voxels and distance-weighted interpolation at points (paper, after eqn ptvzengqiang)."""

from __future__ import annotations

import itertools

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn import functional as F

from vg2gt.kernels.cell_search import nearest_by_cells
from vg2gt.kernels.threads import compilable, parallel_for

QUERIES_AT_ONCE = 256  # per thread


def nearest_neighbors(queries: Tensor, points: Tensor, neighbors: int) -> Tensor:
    """Returns the indices of the nearest points, nearest first; exact.

    Args:
        queries: ``[N, 3]``.
        points: ``[M, 3]``, M >= 1.
        neighbors: number of neighbours; at most M are returned.

    Returns:
        ``[N, min(neighbors, M)]`` int64.
    """
    batches = (torch.zeros(len(rows), dtype=torch.int64, device=rows.device) for rows in (queries, points))
    query_batch, point_batch = batches
    count = min(neighbors, len(points))
    return nearest_in_scenes(queries, query_batch, points, point_batch, count, 1)[0]


def nearest_in_scenes(
    queries: Tensor, query_batch: Tensor, points: Tensor, point_batch: Tensor, neighbors: int, scenes: int
) -> tuple[Tensor, Tensor]:
    """Finds the nearest points in each query's scene, nearest first; exact.

    Uses k-d trees on the CPU and sorted cells elsewhere.

    Args:
        queries: ``[N, 3]``.
        query_batch: ``[N]`` scene index, sorted.
        points: ``[M, 3]``.
        point_batch: ``[M]`` scene index, sorted; every scene with queries has at least one point.
        neighbors: number of neighbours k.
        scenes: B.

    Returns:
        Rows of ``points`` ``[N, k]`` int64, and ``[N, k]`` bool: false, with row 0, where the scene has too few points.
    """
    queries, points = queries.detach(), points.detach()
    if not compilable(queries, points):
        return nearest_by_cells(queries, query_batch, points, point_batch, neighbors, scenes)
    index = torch.zeros(len(queries), neighbors, dtype=torch.int64)
    found = torch.zeros_like(index, dtype=torch.bool)
    numbers = torch.arange(scenes + 1)
    bounds = torch.stack([torch.searchsorted(batch, numbers) for batch in (query_batch, point_batch)], -1).tolist()
    for (begin, first), (end, last) in itertools.pairwise(bounds):
        if begin < end:
            count = min(neighbors, last - first)
            tree = KDTree(points[first:last].numpy())
            index[begin:end, :count] = _by_tree(queries[begin:end].numpy(), tree, count) + first
            found[begin:end, :count] = True
    return index, found


def _by_tree(queries: NDArray, tree: KDTree, count: int) -> Tensor:
    index = np.empty((len(queries), count), np.int64)

    def find(first: int) -> None:
        part = slice(first, first + QUERIES_AT_ONCE)
        index[part] = tree.query(queries[part], k=count)[1].reshape(-1, count)

    parallel_for(range(0, len(queries), QUERIES_AT_ONCE), find)
    return torch.from_numpy(index)


def interpolation_weights(
    queries: Tensor, query_batch: Tensor, points: Tensor, point_batch: Tensor, neighbors: int, scenes: int
) -> tuple[Tensor, Tensor]:
    """Returns neighbours in each scene and weights ``1 / (d^2 + 1e-6)``, normalised to sum 1 (paper: 16 nearest).

    Args:
        queries: ``[N, 3]`` in voxel units, the unit of d.
        query_batch: ``[N]`` scene index, sorted.
        points: ``[M, 3]`` in voxel units.
        point_batch: ``[M]`` scene index, sorted; every scene with queries has at least one point.
        neighbors: number per query; a scene with fewer points uses all of them.
        scenes: B.

    Returns:
        Rows of ``points`` ``[N, neighbors]`` (row 0 with weight 0 where there is none) and weights ``[N, neighbors]``,
        differentiable in queries and points.
    """
    index, found = nearest_in_scenes(queries, query_batch, points, point_batch, neighbors, scenes)
    squared = (queries[:, None] - points[index]).square().sum(-1)  # [N, neighbors]
    weights = torch.where(found, 1 / (squared + 1e-6), 0)
    return index, weights / weights.sum(1, keepdim=True)


def interpolate(features: Tensor, index: Tensor, weights: Tensor) -> Tensor:
    """Returns the weighted sums ``[N, C]`` of neighbours' features ``[M, C]``; index and weights are ``[N, k]``."""
    return F.embedding_bag(index, features, mode="sum", per_sample_weights=weights)
