"""Nearest voxels and distance-weighted interpolation at points (paper, after eqn ptvzengqiang)."""

from __future__ import annotations

import itertools

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn import functional as F

from vg2gt.kernels.curve_codes import z_codes
from vg2gt.kernels.threads import compilable, parallel_for

_QUERIES_AT_ONCE = 256  # per thread, for k-d trees
_BITS = 19  # bits per axis of the finest cells, fewer if the key must hold many scenes
QUERIES = 1 << 17  # queries per chunk
CANDIDATES = 1 << 23  # distances held at once, about 60 bytes each
SHIFT = 0.37  # offset of the second curve, in extents: the two curves rarely jump at the same place
_SLACK = 1e-9  # relative margin for the rounding of distances


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
        part = slice(first, first + _QUERIES_AT_ONCE)
        index[part] = tree.query(queries[part], k=count)[1].reshape(-1, count)

    parallel_for(range(0, len(queries), _QUERIES_AT_ONCE), find)
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


class _Curves:
    """Points sorted along two Morton curves through all scenes, the second with positions shifted.

    Attributes:
        bits: bits per axis of a cell.
        keys: ``[2, M]`` sorted ``scene << 3 bits | code``.
        order: ``[2, M]`` original row of each sorted point.
        points: ``[2, M, 3]`` float64 sorted points, in extents.
    """

    def __init__(self, points: Tensor, batch: Tensor, bits: int) -> None:
        self.bits = bits
        self.keys, self.order = torch.sort(self.key(self.cells(_shifted(points)), batch), stable=True)
        self.points = points[self.order]

    def cells(self, positions: Tensor) -> Tensor:
        """Returns the finest cells ``[..., 3]`` of positions in extents, clamped to the grid; monotone on each axis."""
        cells = (positions / (1 + SHIFT) * (1 << self.bits)).floor()
        return cells.clamp(0, (1 << self.bits) - 1).long()

    def key(self, cells: Tensor, batch: Tensor) -> Tensor:
        """Returns the curve keys of cells ``[..., 3]`` of scenes ``[...]``."""
        return batch << 3 * self.bits | z_codes(cells)


def _shifted(positions: Tensor) -> Tensor:
    """Returns positions ``[N, 3]`` as they are and shifted: ``[2, N, 3]``."""
    return torch.stack((positions, positions + SHIFT))


def nearest_by_cells(
    queries: Tensor, query_batch: Tensor, points: Tensor, point_batch: Tensor, neighbors: int, scenes: int
) -> tuple[Tensor, Tensor]:
    """:func:`nearest_in_scenes` by sorted cells; ties (in float64) are broken arbitrarily.

    Points are sorted along a Morton curve, on which a cell of any size is a contiguous range. The points next to a
    query on the curve bound the distance to its k-th neighbour. The neighbours lie in the cells that the ball of that
    radius meets: at most 27 cells of a matching size. Work is linear in the points, with few host-device
    synchronisations.
    """
    low = points.amin(0).double()
    extent = (points.amax(0).double() - low).amax().clamp(min=torch.finfo(torch.float32).tiny)
    points, queries = (points.double() - low) / extent, (queries.double() - low) / extent
    bits = min(_BITS, (62 - scenes.bit_length()) // 3)
    curves = _Curves(points, point_batch, bits)
    first = torch.searchsorted(point_batch, torch.arange(scenes + 1, device=points.device))
    index = queries.new_zeros(len(queries), neighbors, dtype=torch.int64)
    found = torch.zeros_like(index, dtype=torch.bool)
    for begin in range(0, len(queries), QUERIES):
        part = slice(begin, begin + QUERIES)
        batch = query_batch[part]
        radius = _bound(queries[part], batch, curves, first, neighbors)
        _search(queries[part], batch, radius, curves, index[part], found[part])
    return index, found


def _bound(queries: Tensor, batch: Tensor, curves: _Curves, first: Tensor, neighbors: int) -> Tensor:
    """Bounds the k-th distance ``[N]`` by those among the 2 k points next to each query on a curve, or by infinity."""
    count = curves.keys.shape[1]
    width = min(2 * neighbors, count)
    if width < neighbors:
        return torch.full_like(queries[:, 0], torch.inf)
    place = torch.searchsorted(curves.keys, curves.key(curves.cells(_shifted(queries)), batch)) - width // 2
    begin, end = first[batch], first[batch + 1]  # a scene's points are contiguous on a curve
    place = torch.minimum(torch.maximum(place, begin), torch.maximum(end - width, begin))
    rows = place[..., None] + torch.arange(width, device=place.device)  # [2, N, 2 k]
    which = torch.arange(2, device=place.device)[:, None, None]
    near = curves.points[which, rows.clamp(max=count - 1)]
    squared = torch.where(rows < end[:, None], (queries[:, None] - near).square().sum(-1), torch.inf)
    return squared.kthvalue(neighbors).values.amin(0).sqrt()


def _search(queries: Tensor, batch: Tensor, radius: Tensor, curves: _Curves, index: Tensor, found: Tensor) -> None:
    """Writes the nearest points within the radius of each query into ``index`` and ``found``."""
    starts, counts = _ranges(queries, batch, radius * (1 + _SLACK) + _SLACK / (1 << curves.bits), curves)
    ends = counts.sum(1).cumsum(0)  # [N]
    total = int(ends[-1]) if len(ends) else 0
    bounds = [(0, 0), (len(queries), total)]
    if total > CANDIDATES:
        cuts = torch.arange(1, -(-total // CANDIDATES), device=ends.device) * CANDIDATES
        last = torch.searchsorted(ends, cuts) + 1  # [parts - 1]: number of queries up to and including each cut
        bounds[1:1] = torch.stack((last, ends[last - 1]), -1).tolist()
    for (begin, before), (end, after) in itertools.pairwise(bounds):
        if begin < end:
            part = slice(begin, end)
            inputs = (queries[part], radius[part], starts[part], counts[part], index[part], found[part])
            _nearest(*inputs, after - before, curves)


def _ranges(queries: Tensor, batch: Tensor, radius: Tensor, curves: _Curves) -> tuple[Tensor, Tensor]:
    """Returns the start on the curve and the number of points of each cell that a ball meets, ``[N, 27]`` each."""
    low, high = curves.cells(queries - radius[:, None]), curves.cells(queries + radius[:, None])
    # the finest level at which three cells per axis cover the ball
    level = (torch.frexp((high - low).amax(-1).double())[1].long() - 1).clamp(min=0)[:, None]  # [N, 1]
    low, high = low >> level, high >> level
    steps = torch.cartesian_prod(*[torch.arange(3, device=low.device)] * 3)  # [27, 3]
    cells = low[:, None] + steps  # [N, 27, 3]
    key = curves.key(cells << level[..., None], batch[:, None])
    starts = torch.searchsorted(curves.keys[0], key)
    counts = torch.searchsorted(curves.keys[0], key + (1 << 3 * level)) - starts
    return starts, torch.where((cells <= high[:, None]).all(-1), counts, 0)


def _nearest(
    queries: Tensor,
    radius: Tensor,
    starts: Tensor,
    counts: Tensor,
    index: Tensor,
    found: Tensor,
    total: int,
    curves: _Curves,
) -> None:
    """Writes the nearest points in the ranges ``[N, 27]`` of each query; the ranges hold ``total`` points in all."""
    sizes = counts.flatten()
    owner = torch.arange(len(sizes), device=sizes.device).repeat_interleave(sizes, output_size=total)  # [total]
    place = torch.arange(total, device=sizes.device) + (starts.flatten() - sizes.cumsum(0) + sizes)[owner]
    query = owner // starts.shape[1]
    squared = (queries[query] - curves.points[0][place]).square().sum(-1)
    inside = (squared <= (radius * (1 + _SLACK)).square()[query]).nonzero()[:, 0]
    query, place, squared = query[inside], place[inside], squared[inside]
    order = torch.argsort(squared, stable=True)
    order = order[torch.argsort(query[order], stable=True)]
    query, place = query[order], place[order]
    rank = torch.arange(len(query), device=query.device) - torch.searchsorted(query, query)
    # points beyond the k-th go to an extra column that is dropped: filtering them would need their number
    column = rank.clamp(max=index.shape[1])
    rows = query.new_zeros(len(queries), index.shape[1] + 1).index_put_((query, column), curves.order[0][place])
    there = torch.zeros_like(rows, dtype=torch.bool).index_put_((query, column), torch.ones_like(query).bool())
    index.copy_(rows[:, :-1])
    found.copy_(there[:, :-1])
