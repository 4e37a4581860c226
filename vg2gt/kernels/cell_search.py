"""Exact nearest neighbours on any device by searching sorted cells: work linear in the points, a few waits.

Points are sorted along a Morton curve, on which the cells of every size are ranges. Those next to a query on the curve
bound the distance to its k-th neighbour; the neighbours lie in the at most 27 cells, of a size to match, that the ball
of that radius meets.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from vg2gt.kernels.curve_codes import z_codes

BITS = 19  # cells along an axis as a power of two, fewer where many scenes must be told apart
QUERIES = 1 << 18  # bounded at a time
CANDIDATES = 1 << 23  # distances held at once, some 60 bytes each
SHIFT = 0.37  # of the second curve, in extents: where one curve leaps, the other seldom does
SLACK = 1e-9  # by which rounding may shorten a distance; relative


class _Curve:
    """Points along a Morton curve through all scenes.

    Attributes:
        bits: of a cell along an axis.
        shift: added to positions before they are coded.
        keys: ``[M]`` sorted ``scene << 3 bits | code``.
        order: ``[M]`` row of each.
        points: ``[M, 3]`` float64 in that order, in extents.
    """

    def __init__(self, points: Tensor, batch: Tensor, shift: float, bits: int) -> None:
        self.bits, self.shift = bits, shift
        self.keys, self.order = torch.sort(self.key(self.cells(points), batch), stable=True)
        self.points = points[self.order]

    def cells(self, positions: Tensor) -> Tensor:
        """Smallest cells ``[N, 3]`` of positions in extents; monotone along every axis, those outside at the border."""
        cells = ((positions + self.shift) / (1 + SHIFT) * (1 << self.bits)).floor()
        return cells.clamp(0, (1 << self.bits) - 1).long()

    def key(self, cells: Tensor, batch: Tensor) -> Tensor:
        """Place of cells ``[..., 3]`` of the scenes ``[...]`` on the curve."""
        return batch << 3 * self.bits | z_codes(cells)


def nearest_by_cells(
    queries: Tensor, query_batch: Tensor, points: Tensor, point_batch: Tensor, neighbors: int, scenes: int
) -> tuple[Tensor, Tensor]:
    """Nearest points of a query's own scene, nearest first; of equal distances (in float64) any may be found.

    Args:
        queries: ``[N, 3]``.
        query_batch: ``[N]`` scene index.
        points: ``[M, 3]``, M >= 1.
        point_batch: ``[M]`` scene index, sorted.
        neighbors: k.
        scenes: B.

    Returns:
        Rows of ``points`` ``[N, k]`` int64 and whether there are so many ``[N, k]`` bool; row 0 where not.
    """
    low = points.amin(0).double()
    extent = (points.amax(0).double() - low).amax().clamp(min=torch.finfo(torch.float32).tiny)
    points, queries = (points.double() - low) / extent, (queries.double() - low) / extent
    bits = min(BITS, (62 - scenes.bit_length()) // 3)
    curves = [_Curve(points, point_batch, shift, bits) for shift in (0.0, SHIFT)]
    first = torch.searchsorted(point_batch, torch.arange(scenes + 1, device=points.device))
    index = queries.new_zeros(len(queries), neighbors, dtype=torch.int64)
    found = torch.zeros_like(index, dtype=torch.bool)
    for begin in range(0, len(queries), QUERIES):
        part = slice(begin, begin + QUERIES)
        batch = query_batch[part]
        radius = torch.stack([_bound(queries[part], batch, curve, first, neighbors) for curve in curves]).amin(0)
        _search(queries[part], batch, radius, curves[0], index[part], found[part])
    return index, found


def _bound(queries: Tensor, batch: Tensor, curve: _Curve, first: Tensor, neighbors: int) -> Tensor:
    """Distance ``[N]`` within which k points lie: the k-th of the 2 k next to the query on a curve, or infinity."""
    width = min(2 * neighbors, len(curve.keys))
    place = torch.searchsorted(curve.keys, curve.key(curve.cells(queries), batch)) - width // 2
    begin, end = first[batch], first[batch + 1]  # a scene's points adjoin on the curve
    place = torch.minimum(torch.maximum(place, begin), torch.maximum(end - width, begin))
    rows = place[:, None] + torch.arange(width, device=place.device)  # [N, 2 k]
    squared = (queries[:, None] - curve.points[rows.clamp(max=len(curve.keys) - 1)]).square().sum(-1)
    squared = torch.where(rows < end[:, None], squared, torch.inf)
    if width < neighbors:
        return torch.full_like(squared[:, 0], torch.inf)
    return squared.kthvalue(neighbors, 1).values.sqrt()


def _search(queries: Tensor, batch: Tensor, radius: Tensor, curve: _Curve, index: Tensor, found: Tensor) -> None:
    """Writes into ``index`` and ``found`` the nearest of all points within the radius of every query."""
    starts, counts = _ranges(queries, batch, radius * (1 + SLACK) + SLACK / (1 << curve.bits), curve)
    ends = counts.sum(1).cumsum(0)  # [N]
    total = int(ends[-1]) if len(ends) else 0
    cuts = torch.arange(1, -(-total // CANDIDATES), device=ends.device) * CANDIDATES
    last = torch.searchsorted(ends, cuts) + 1  # [parts - 1]: queries before and at each cut
    taken = ends[last - 1]
    bounds = [(0, 0), *torch.stack((last, taken), -1).tolist(), (len(queries), total)]
    for (begin, before), (end, after) in itertools.pairwise(bounds):
        part = slice(begin, end)
        if begin < end:
            _nearest(
                queries[part], radius[part], starts[part], counts[part], after - before, curve, index[part], found[part]
            )


def _ranges(queries: Tensor, batch: Tensor, radius: Tensor, curve: _Curve) -> tuple[Tensor, Tensor]:
    """Where the cells that a ball meets begin on the curve, and how many points each holds: ``[N, 27]`` both."""
    low, high = curve.cells(queries - radius[:, None]), curve.cells(queries + radius[:, None])
    # the smallest cells of which three a side are enough
    level = (torch.frexp((high - low).amax(-1).double())[1].long() - 1).clamp(min=0)[:, None]  # [N, 1]
    low, high = low >> level, high >> level
    steps = torch.cartesian_prod(*[torch.arange(3, device=low.device)] * 3)  # [27, 3]
    cells = low[:, None] + steps  # [N, 27, 3]
    key = curve.key(cells << level[..., None], batch[:, None])
    starts = torch.searchsorted(curve.keys, key)
    counts = torch.searchsorted(curve.keys, key + (1 << 3 * level)) - starts
    return starts, torch.where((cells <= high[:, None]).all(-1), counts, 0)


def _nearest(
    queries: Tensor,
    radius: Tensor,
    starts: Tensor,
    counts: Tensor,
    total: int,
    curve: _Curve,
    index: Tensor,
    found: Tensor,
) -> None:
    """The nearest of the points in the ranges ``[N, 27]`` of every query, ``total`` of all."""
    sizes = counts.flatten()
    owner = torch.arange(len(sizes), device=sizes.device).repeat_interleave(sizes, output_size=total)  # [total]
    place = torch.arange(total, device=sizes.device) + (starts.flatten() - sizes.cumsum(0) + sizes)[owner]
    query = owner // starts.shape[1]
    squared = (queries[query] - curve.points[place]).square().sum(-1)
    inside = (squared <= (radius * (1 + SLACK)).square()[query]).nonzero()[:, 0]
    query, place, squared = query[inside], place[inside], squared[inside]
    order = torch.argsort(squared, stable=True)
    order = order[torch.argsort(query[order], stable=True)]
    query, place = query[order], place[order]
    rank = torch.arange(len(query), device=query.device) - torch.searchsorted(query, query)
    # those beyond the k-th go to a column that is thrown away: leaving them out would need their number
    column = rank.clamp(max=index.shape[1])
    rows = query.new_zeros(len(queries), index.shape[1] + 1).index_put_((query, column), curve.order[place])
    there = torch.zeros_like(rows, dtype=torch.bool).index_put_((query, column), torch.ones_like(query).bool())
    index.copy_(rows[:, :-1])
    found.copy_(there[:, :-1])
