"""World-anchored voxels: assigns points to cells and pools them by confidence (paper, eqn voxelfeature)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.geometry.cameras import focal_lengths
from vg2gt.types import Geometry

_MAX_CELLS = 1 << 18  # cells on either side of the origin: 19 bits per axis leave 6 of a code's 63 for the scene


@dataclass(frozen=True)
class VoxelPlan:
    """Assignment of N points to M voxels, which are sorted by (scene, x, y, z).

    Attributes:
        grid: ``[M, 3]`` int64 cell index, ``floor(x / voxel_size)``.
        batch: ``[M]`` int64 scene index, sorted.
        order: rows of the points that lie in a voxel, sorted by voxel, ties in input order.
        starts: ``[M]`` first position of each voxel in ``order``.
        counts: ``[M]`` int64 number of points in each voxel.
        voxel_of: ``[N]`` voxel of every point, -1 for points in no voxel.
    """

    grid: Tensor
    batch: Tensor
    order: Tensor
    starts: Tensor
    counts: Tensor
    voxel_of: Tensor

    def __len__(self) -> int:
        return self.grid.shape[0]

    def select(self, keep: Tensor) -> VoxelPlan:
        """Returns the plan of the voxels where ``keep`` ``[M]`` bool is true; other voxels' points are left out."""
        new_index = torch.where(keep, keep.cumsum(0) - 1, -1)
        new_index = torch.cat((new_index, new_index.new_tensor([-1])))  # -1 stays -1
        counts = self.counts[keep]
        return VoxelPlan(
            grid=self.grid[keep],
            batch=self.batch[keep],
            order=self.order[torch.repeat_interleave(keep, self.counts)],
            starts=counts.cumsum(0) - counts,
            counts=counts,
            voxel_of=new_index[self.voxel_of],
        )


def mixed_radix_keys(
    grid: Tensor, batch: Tensor, margin: int = 0, spans: Sequence[int] | None = None
) -> tuple[Tensor, tuple[int, int, int]]:
    """Returns one collision-free int64 key per cell ``[M, 3]`` and scene ``[M]``, ordered like (scene, x, y, z).

    Args:
        grid: cells, any sign.
        batch: scene index >= 0.
        margin: cells to leave free on every side, so that keys of neighbours up to ``margin`` away never wrap.
        spans: number of cells along x, y and z of a grid that begins at 0, and number of scenes; None computes them,
            which synchronises with a GPU.

    Returns:
        The keys ``[M]`` and the key increments of one step along x, y and z.

    Raises:
        ValueError: if the keys do not fit into 63 bits.
    """
    if not len(grid):
        return batch, (1, 1, 1)
    if spans is None:
        low = grid.amin(0)
        grid = grid - low
        # one transfer from the GPU instead of one per number
        spans = torch.cat((grid.amax(0) + 1, batch.max()[None] + 1)).tolist()
    *extent, scenes = spans
    extent = [cells + 2 * margin for cells in extent]
    if scenes * extent[0] * extent[1] * extent[2] >= 1 << 63:
        raise ValueError(
            f"{scenes} scenes of {extent[0]} x {extent[1]} x {extent[2]} voxels exceed 63-bit indices; "
            "increase voxel_size or remove distant points"
        )
    steps = (extent[1] * extent[2], extent[2], 1)
    x, y, z = (grid + margin if margin else grid).unbind(-1)
    return ((batch * extent[0] + x) * extent[1] + y) * extent[2] + z, steps


def scene_counts(batch: Tensor, scenes: int) -> Tensor:
    """Counts the rows ``[B]`` of each scene in sorted ``batch`` ``[M]``; unlike ``bincount``, it never synchronises."""
    return torch.searchsorted(batch, torch.arange(scenes + 1, device=batch.device)).diff()


def point_cells(points: Tensor, batch: Tensor, voxel_size: Tensor) -> Tensor:
    """Returns positions in units of voxels.

    Args:
        points: ``[N, 3]``, float32 or better (bfloat16 would move most points to another 2 mm cell).
        batch: ``[N]`` scene index.
        voxel_size: ``[B]`` edge length in scene units.

    Returns:
        ``[N, 3]`` float64. Divides instead of multiplying by 1/v, so that points on cell faces follow the definition.
    """
    sizes = voxel_size.double() if len(voxel_size) == 1 else voxel_size.double()[batch, None]
    return points.double() / sizes


def in_range(cells: Tensor) -> Tensor:
    """Returns ``[N]`` bool: whether cells ``[N, 3]`` are finite and close enough to the origin to be indexed."""
    return (cells.abs() < _MAX_CELLS).all(-1)


def plan_voxels(cells: Tensor, batch: Tensor, valid: Tensor | None = None, valid_count: int | None = None) -> VoxelPlan:
    """Groups points by cell.

    Args:
        cells: ``[N, 3]`` positions in units of voxels; invalid rows may hold anything.
        batch: ``[N]`` int64 scene index.
        valid: ``[N]`` bool, the points to use, which must be finite; None: all.
        valid_count: their number; None: counted, which synchronises with a GPU once more.

    Returns:
        The plan. It is deterministic, and only the order within a voxel depends on the order of points.

    Raises:
        ValueError: if the points span more cells than 63 bits can index.
    """
    rows = None
    if valid is not None and valid_count != len(batch):
        rows = valid.nonzero()[:, 0] if valid_count is None else _marked(valid, valid_count)
    floors = torch.floor(cells.detach() if rows is None else cells.detach()[rows]).long()
    scenes = batch if rows is None else batch[rows]
    keys, order = torch.sort(mixed_radix_keys(floors, scenes)[0], stable=True)
    _, inverse, counts = torch.unique_consecutive(keys, return_inverse=True, return_counts=True)
    starts = counts.cumsum(0) - counts
    first = order[starts]
    point_rows = order if rows is None else rows[order]
    voxel_of = torch.full_like(batch, -1)
    voxel_of[point_rows] = inverse
    return VoxelPlan(floors[first], scenes[first], point_rows, starts, counts, voxel_of)


def _marked(mask: Tensor, count: int) -> Tensor:
    """Returns the ``count`` rows where a mask is true; unlike ``nonzero``, never synchronises."""
    place = torch.where(mask, mask.cumsum(0) - 1, count)  # all others share the last place, which is dropped
    rows = torch.arange(len(mask), device=mask.device)
    return rows.new_empty(count + 1).scatter_(0, place, rows)[:count]


class _WeightedMean(torch.autograd.Function):
    """``sum n f / sum n`` over every voxel; the backward pass only gathers, so it is fast and deterministic."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, weights: Tensor, plan: VoxelPlan) -> Tensor:
        """Returns the means ``[M, C]`` of ``values [N, C]`` in each voxel, weighted by ``weights [N]``."""
        dtype = torch.promote_types(values.dtype, torch.float32)
        ordered = weights.to(dtype)[plan.order]
        total = torch.segment_reduce(ordered, "sum", lengths=plan.counts, unsafe=True)
        share = ordered / torch.repeat_interleave(total, plan.counts, output_size=len(plan.order))
        mean = F.embedding_bag(plan.order, values.to(dtype), plan.starts, mode="sum", per_sample_weights=share)
        ctx.save_for_backward(values, weights, total, mean)
        ctx.plan = plan
        return mean

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, Tensor | None, None]:  # pyright: ignore
        """Returns the gradients of the values and the weights."""
        (grad,) = grad_outputs
        values, weights, total, mean = ctx.saved_tensors
        plan: VoxelPlan = ctx.plan
        rows = plan.voxel_of.clamp(min=0)
        used = plan.voxel_of >= 0
        inverse_total = torch.where(used, 1 / total.index_select(0, rows), 0)
        grad_rows = grad.index_select(0, rows)
        grad_values = grad_weights = None
        if ctx.needs_input_grad[1]:
            along = (grad_rows * values).sum(-1) - (grad * mean).sum(-1).index_select(0, rows)
            grad_weights = torch.where(used, along * inverse_total, 0).to(weights.dtype)
        if ctx.needs_input_grad[0]:
            grad_values = grad_rows.mul_((weights * inverse_total)[:, None]).to(values.dtype)
        return grad_values, grad_weights, None


def pool_mean(values: Tensor, weights: Tensor, plan: VoxelPlan) -> Tensor:
    """Returns the confidence-weighted mean of every voxel (paper, eqn voxelfeature, first line).

    Args:
        values: ``[N, C]``; must be finite, also for points in no voxel.
        weights: ``[N]`` confidence > 0, finite.
        plan: the voxels.

    Returns:
        ``[M, C]``, float32 or better, differentiable in values and weights.
    """
    if not len(plan):  # nothing to pool; the product keeps the autograd graph
        return values[:0].to(torch.promote_types(values.dtype, torch.float32)) * weights[:0, None]
    return _WeightedMean.apply(values, weights, plan)  # pyright: ignore[reportReturnType]


def pool_mean_of_chunks(chunks: Iterable[Tensor], weights: Tensor, plan: VoxelPlan) -> Tensor:
    """Computes :func:`pool_mean` without gradient from consecutive chunks of rows, which bounds the memory."""
    dtype = torch.promote_types(weights.dtype, torch.float32)
    ordered = weights.to(dtype)[plan.order]
    voxel = plan.voxel_of[plan.order]
    share = ordered / torch.segment_reduce(ordered, "sum", lengths=plan.counts, unsafe=True)[voxel]
    means: Tensor | None = None
    begin = 0
    for values in chunks:
        rows, starts, parts = plan.order, plan.starts, share
        if len(values) < len(plan.voxel_of):
            inside = ((plan.order >= begin) & (plan.order < begin + len(values))).nonzero()[:, 0]
            rows, parts = plan.order[inside] - begin, share[inside]
            starts = torch.searchsorted(voxel[inside], torch.arange(len(plan), device=voxel.device))
        part = F.embedding_bag(rows, values.to(dtype), starts, mode="sum", per_sample_weights=parts)
        means = part if means is None else means.add_(part)
        begin += len(values)
    assert means is not None
    return means


def pool_min(values: Tensor, plan: VoxelPlan) -> Tensor:
    """Returns the minimum ``[M]`` of the points' ``[N]`` values in every voxel (paper, eqn voxelfeature, line 2)."""
    ordered = values[plan.order]
    return torch.segment_reduce(ordered, "min", lengths=plan.counts, unsafe=True) if len(plan) else ordered


def pool_sum(values: Tensor, plan: VoxelPlan) -> Tensor:
    """Returns the sum ``[M]`` of the points' ``[N]`` values in every voxel."""
    ordered = values[plan.order]
    return torch.segment_reduce(ordered, "sum", lengths=plan.counts, unsafe=True) if len(plan) else ordered


def scene_voxel_size(
    geometry: Geometry, voxel_size: float, min_footprint: float, coarsen: Tensor | None = None
) -> Tensor:
    """Returns each scene's voxel edge length: the configured one, but at least some pixels at the median depth.

    Args:
        geometry: depth and cameras in scene units.
        voxel_size: edge length in scene units.
        min_footprint: smallest edge in pixels, ``min_footprint * median(depth) / focal`` in scene units; 0 disables it.
        coarsen: ``[B]`` factors on the smallest edge; None: 1.

    Returns:
        ``[B]`` float32, detached.
    """
    if min_footprint <= 0:
        return torch.full((len(geometry.depth),), voxel_size, dtype=torch.float32, device=geometry.depth.device)
    sizes = []
    factors = torch.ones_like(geometry.scale) if coarsen is None else coarsen
    scenes = (geometry.depth.detach(), geometry.cameras.intrinsics.detach(), factors.detach())
    for depth, intrinsics, factor in zip(*scenes, strict=True):
        valid = depth[(depth > 0) & torch.isfinite(depth)]
        size = torch.full((), voxel_size, dtype=torch.float32, device=depth.device)
        if valid.numel():
            focal = focal_lengths(intrinsics).mean()
            size = torch.maximum(size, (factor * min_footprint * valid.median() / focal).float())
        sizes.append(size)
    return torch.stack(sizes)
