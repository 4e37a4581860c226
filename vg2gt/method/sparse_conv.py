"""Submanifold sparse convolution in plain torch: outputs exist only at the input cells; deterministic.

On a CPU, kernel offsets are processed one at a time; on other devices, as many at once as memory allows.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from vg2gt.geometry.precision import autocast_dtype
from vg2gt.method.grid import mixed_radix_keys

Pairs = list[tuple[Tensor, Tensor]]
CHUNK = 1 << 22  # cells times offsets per lookup
HELD = 1 << 28  # elements of gathered rows and products held at once, on devices other than the CPU


class Cells(NamedTuple):
    """Distinct cells ``grid [M, 3]`` int64 of scenes ``batch [M]``, and the odd edge length of a cubic kernel.

    ``spans`` is the argument of :func:`vg2gt.method.grid.mixed_radix_keys`; None if unknown.
    """

    grid: Tensor
    batch: Tensor
    kernel_size: int
    spans: Sequence[int] | None = None


@dataclass(frozen=True)
class NeighborTable:
    """Neighbours at the T = k^3 - 1 kernel offsets without the centre, x slowest; offset T - 1 - t mirrors t.

    P is the largest number of neighbours at one offset.

    Attributes:
        sources: ``[T, P + 1]`` rows of the neighbours, padded with M; the last column is always padding.
        targets: ``[T, P + 1]`` rows of the voxels that have these neighbours, padded with M.
        slots: ``[M, T + 1]`` index of a voxel's neighbour in ``sources.flatten()``; without one, the last of its row.
            The last column is that of the voxels themselves, which follow the neighbours.
        back: ``[M, T + 1]`` index in ``targets.flatten()`` of the voxel whose neighbour a voxel is, as in ``slots``.
        bags: ``[M]`` first index of each voxel in ``slots.flatten()``.
    """

    sources: Tensor
    targets: Tensor
    slots: Tensor
    back: Tensor
    bags: Tensor

    def parts(self, width: int) -> Iterator[slice]:
        """Returns slices of offsets whose rows of ``width`` elements may be held together."""
        offsets, rows = self.sources.shape
        some = max(1, HELD // (rows * width))
        return (slice(begin, min(begin + some, offsets)) for begin in range(0, offsets, some))

    def sums(self, rows: Tensor, slots: Tensor, taps: Tensor, center: Tensor, bias: Tensor | None = None) -> Tensor:
        """Returns each voxel's sum ``[M, out]`` of products.

        Args:
            rows: ``[M + 1, in]``, the last of zeros.
            slots: ``slots`` to multiply the neighbours, ``back`` the voxels whose neighbour one is.
            taps: ``[T, in, out]`` matrices of the offsets.
            center: ``[in, out]`` matrix of the voxel itself.
            bias: ``[out]``.
        """
        which = self.sources if slots is self.slots else self.targets
        out: Tensor | None = None
        for some in self.parts(taps.shape[1] + taps.shape[2]):
            last = some.stop == len(taps)
            found, factors = rows[which[some]], taps[some]
            count = found.shape[0] * found.shape[1]
            products = found.new_empty(count + last * (len(rows) - 1), taps.shape[2])
            torch.bmm(found, factors, out=products[:count].view(*found.shape[:2], -1))
            if last:
                own, out_own = (rows[:-1], center), products[count:]
                torch.mm(*own, out=out_own) if bias is None else torch.addmm(bias, *own, out=out_own)
            bags = slots[:, some.start : some.stop + last]
            if bags.shape == slots.shape:
                return F.embedding_bag(slots.flatten(), products, self.bags, mode="sum")
            part = F.embedding_bag(bags - some.start * which.shape[1], products, mode="sum")
            out = part.to(torch.promote_types(part.dtype, torch.float32)) if out is None else out + part
        assert out is not None
        return out.to(rows.dtype)


def neighbors(cells: Sequence[Cells]) -> list[Pairs] | list[NeighborTable]:
    """Returns the neighbours in each set of cells: pairs on a CPU, tables on other devices."""
    if one_by_one(cells[0].grid.device):
        return [neighbor_pairs(*each) for each in cells]
    return neighbor_tables(cells)


def one_by_one(device: torch.device) -> bool:
    """Whether kernel offsets are processed one at a time on this device."""
    return device.type == "cpu"


def neighbor_tables(cells: Sequence[Cells]) -> list[NeighborTable]:
    """Returns one table per set of cells; synchronises once, for the largest number of pairs at an offset."""
    alike: dict[tuple[int, int | None], list[int]] = {}  # sets of one kernel size are searched together
    for index, each in enumerate(cells):
        alike.setdefault((each.kernel_size, index if each.spans is None else None), []).append(index)
    found = [torch.empty(0)] * len(cells)
    for sets in alike.values():
        for index, rows in zip(sets, _rows_of_sets([cells[index] for index in sets]), strict=True):
            found[index] = rows
    ranks = [(rows < rows.shape[1]).cumsum(1) for rows in found]  # of the voxels that have a neighbour at an offset
    most = [rank[:, -1].amax() if rank.numel() else rank.new_zeros(()) for rank in ranks]
    return [_tabulate(*each) for each in zip(found, ranks, torch.stack(most).tolist(), strict=True)]


def _rows_of_sets(cells: Sequence[Cells]) -> list[Tensor]:
    """:func:`_neighbor_rows` of each set of cells; several, which must have spans, become scenes of a single one."""
    if len(cells) == 1:
        return [_neighbor_rows(*cells[0])]
    *extent, scenes = (max(each) for each in zip(*(part.spans or () for part in cells), strict=True))
    grid = torch.cat([part.grid for part in cells])
    batch = torch.cat([part.batch + i * scenes for i, part in enumerate(cells)])
    rows = _neighbor_rows(grid, batch, cells[0].kernel_size, (*extent, scenes * len(cells)))
    counts = [len(part.grid) for part in cells]
    begins = itertools.accumulate(counts, initial=0)
    # no neighbours, marked by the total number of cells, are marked by the set's
    own = zip(rows.split(counts, 1), begins, counts, strict=False)
    return [(part - begin).clamp_(max=count) for part, begin, count in own]


def _neighbor_rows(grid: Tensor, batch: Tensor, kernel_size: int, spans: Sequence[int] | None = None) -> Tensor:
    """Returns the row ``[T, M]`` of every voxel's neighbour at every offset; M where there is none."""
    keys, order, moves = _sorted_cells(grid, batch, kernel_size, spans)
    count, half = len(keys), len(moves)
    wanted = keys + moves[:, None]  # [T / 2, M]
    place = torch.searchsorted(keys, wanted).clamp_(max=count - 1)
    before = torch.empty_like(place)
    before[:, order] = torch.where(keys[place] == wanted, order[place], count)
    # if j is the neighbour of i at an offset, i is that of j at the opposite one; the last column takes the misses
    rows = torch.arange(count, device=keys.device).expand(half, -1)
    after = before.new_full((half, count + 1), count).scatter_(1, before, rows)[:, :-1]
    return torch.cat((before, after.flip(0)))


def _tabulate(rows: Tensor, ranks: Tensor, most: int) -> NeighborTable:
    """Builds the table from neighbour rows and their ranks ``[T, M]``, with at most ``most`` neighbours per offset."""
    offsets, count = rows.shape
    column = torch.where(rows < count, ranks - 1, most)
    sources, targets = (rows.new_full((offsets, most + 1), count) for _ in range(2))
    sources.scatter_(1, column, rows)
    voxels = torch.arange(count, device=rows.device)
    targets.scatter_(1, column, voxels.expand(offsets, -1))
    targets[:, -1] = count
    # a last column for voxels that are nobody's neighbour; whose neighbour a voxel is, the opposite offset tells
    slots = F.pad(column, (0, 1), value=most) + (most + 1) * torch.arange(offsets, device=rows.device)[:, None]
    back = slots.gather(1, rows.flip(0))
    itself = voxels[None] + offsets * (most + 1)
    both = (torch.cat((part, itself)).t().contiguous() for part in (slots[:, :-1], back))
    return NeighborTable(sources, targets, *both, bags=voxels * (offsets + 1))


def neighbor_pairs(grid: Tensor, batch: Tensor, kernel_size: int, spans: Sequence[int] | None = None) -> Pairs:
    """Returns the pairs of occupied cells at the first half of a cubic kernel's offsets; the other half mirrors them.

    Args:
        grid: ``[M, 3]`` int64 distinct cells.
        batch: ``[M]`` scene index.
        kernel_size: odd edge length of the kernel.
        spans: argument of :func:`vg2gt.method.grid.mixed_radix_keys`; None if unknown.

    Returns:
        For each of the ``kernel_size^3 // 2`` offsets before the centre (x slowest), the rows ``(i, j)`` with
        ``grid[j] = grid[i] + offset``.
    """
    keys, order, moves = _sorted_cells(grid, batch, kernel_size, spans)
    counts, rows, neighbors = [], [], []
    # many offsets at a time, as each nonzero() synchronises
    for some in moves.split(max(1, CHUNK // max(1, len(keys)))):
        wanted = keys + some[:, None]
        place = torch.searchsorted(keys, wanted).clamp_(max=len(keys) - 1)
        found = keys[place] == wanted
        offset, row = found.nonzero().unbind(-1)
        counts.append(found.sum(-1))
        rows.append(order[row])
        neighbors.append(order[place[offset, row]])
    lengths = torch.cat(counts).tolist()
    return list(zip(torch.cat(rows).split(lengths), torch.cat(neighbors).split(lengths), strict=True))


def _sorted_cells(
    grid: Tensor, batch: Tensor, kernel_size: int, spans: Sequence[int] | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns sorted keys ``[M]``, their rows ``[M]``, and the key increments of the offsets before the centre."""
    radius = kernel_size // 2
    keys, steps = mixed_radix_keys(grid, batch, radius, spans)
    keys, order = torch.sort(keys)
    # built from ranges: copying a list to a GPU would synchronise
    axes = [torch.arange(-radius, radius + 1, device=keys.device) * step for step in steps]
    moves = axes[0][:, None, None] + axes[1][:, None] + axes[2]
    return keys, order, moves.flatten()[: kernel_size**3 // 2]


class _BatchedConvolution(torch.autograd.Function):
    """Gathers, multiplies and sums many kernel offsets at once; the backward pass gathers again."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, weight: Tensor, bias: Tensor | None, table: NeighborTable) -> Tensor:
        """Returns ``[M, out]`` for ``features [M, in]``, ``weight [out, k, k, k, in]`` and ``bias [out]``.

        The result has the dtype of the weight.
        """
        padded = _padded(features, weight.dtype)
        ctx.save_for_backward(padded, weight)
        ctx.table, ctx.dtype = table, features.dtype
        return table.sums(padded, table.slots, *_taps(weight), bias)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore
        """Returns the gradients of the features, the weight and the bias."""
        padded, weight = ctx.saved_tensors
        table: NeighborTable = ctx.table
        grad = _padded(grad_outputs[0], padded.dtype)
        taps, center = _taps(weight)
        of_taps: list[Tensor] = []  # [out, in] each
        for some in table.parts(taps.shape[1] + taps.shape[2]):
            of_taps += (grad[table.targets[some]].mT @ padded[table.sources[some]]).unbind()
        of_taps.insert(len(of_taps) // 2, grad[:-1].t() @ padded[:-1])
        of_features = table.sums(grad, table.back, taps.mT, center.t()).to(ctx.dtype)
        of_bias = grad_outputs[0].sum(0) if ctx.needs_input_grad[2] else None
        return of_features, torch.stack(of_taps, 1).view(weight.shape), of_bias, None


def _taps(weight: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the matrices ``[T, in, out]`` of all offsets without the centre, and the centre's ``[in, out]``."""
    taps = weight.flatten(1, 3).permute(1, 2, 0)
    half = len(taps) // 2
    return torch.cat((taps[:half], taps[half + 1 :])), taps[half]


def _padded(rows: Tensor, dtype: torch.dtype) -> Tensor:
    """Converts rows ``[M, C]`` and appends one of zeros."""
    padded = rows.new_zeros(len(rows) + 1, rows.shape[1], dtype=dtype)
    padded[:-1] = rows
    return padded


class _SubmanifoldConvolution(torch.autograd.Function):
    """Gathers, multiplies and adds one kernel offset at a time; the backward pass gathers again."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, weight: Tensor, pairs: Pairs) -> Tensor:
        """Returns ``[M, out]`` for ``features [M, in]`` and ``weight [out, k, k, k, in]``."""
        taps = weight.flatten(1, 3).unbind(1)  # k^3 times [out, in]
        out = (features @ taps[len(pairs)].t()).to(torch.promote_types(features.dtype, torch.float32))
        for t, (i, j) in enumerate(pairs):
            out.index_add_(0, i, (features.index_select(0, j) @ taps[t].t()).to(out.dtype))
            out.index_add_(0, j, (features.index_select(0, i) @ taps[-1 - t].t()).to(out.dtype))
        ctx.save_for_backward(features, weight)
        ctx.pairs = pairs
        return out

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, Tensor, None]:  # pyright: ignore
        """Returns the gradients of the features and the weight."""
        features, weight = ctx.saved_tensors
        grad = grad_outputs[0].to(features.dtype)
        pairs: Pairs = ctx.pairs
        taps = weight.flatten(1, 3).unbind(1)  # k^3 times [out, in]
        grad_weight = torch.empty_like(weight)
        grad_taps = grad_weight.flatten(1, 3).unbind(1)
        grad_features = grad @ taps[len(pairs)]
        grad_taps[len(pairs)].copy_(grad.t() @ features)
        for t, (i, j) in enumerate(pairs):
            for tap, target, source in ((t, i, j), (-1 - t, j, i)):
                grad_rows = grad.index_select(0, target)
                grad_features.index_add_(0, source, grad_rows @ taps[tap])
                grad_taps[tap].copy_(grad_rows.t() @ features.index_select(0, source))
        return grad_features, grad_weight, None


class SubmanifoldConv3d(nn.Module):
    """Convolution over occupied voxels: equals a dense ``conv3d``, zero-filled elsewhere and read at occupied cells.

    Args:
        in_channels: input channels.
        out_channels: output channels.
        kernel_size: odd edge length of the cubic kernel.
        bias: whether to add a bias.

    Attributes:
        weight: ``[out, k, k, k, in]``, axes x, y, z.
    """

    def __init__(self, in_channels: int, out_channels: int, kernel_size: int, bias: bool = True) -> None:
        super().__init__()
        self.kernel_size = kernel_size
        bound = (in_channels * kernel_size**3) ** -0.5
        shape = (out_channels, kernel_size, kernel_size, kernel_size, in_channels)
        self.weight = nn.Parameter(torch.empty(shape).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.zeros(out_channels)) if bias else None

    def forward(self, features: Tensor, pairs: Pairs | NeighborTable) -> Tensor:
        """Convolves ``[M, in]`` features.

        Args:
            features: ``[M, in]``.
            pairs: result of :func:`neighbors` for this kernel size.

        Returns:
            ``[M, out]``. Under autocast, products and the result have its dtype; they are summed in float32.
        """
        weight, bias = self.weight, self.bias
        if torch.is_autocast_enabled(features.device.type):
            weight = weight.to(autocast_dtype(features))
            bias = None if bias is None else bias.to(weight.dtype)
        if isinstance(pairs, NeighborTable):
            return _BatchedConvolution.apply(features, weight, bias, pairs)  # pyright: ignore
        out: Tensor = _SubmanifoldConvolution.apply(features.to(weight.dtype), weight, pairs)  # pyright: ignore
        return (out if bias is None else out + bias).to(weight.dtype)
