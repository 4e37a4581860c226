"""Voxel statistics that can be merged over parts of a scene, such as windows of views in a long capture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from vg2gt.method.grid import VoxelPlan, mixed_radix_keys
from vg2gt.types import TensorRecord


@dataclass(frozen=True)
class PooledVoxels(TensorRecord):
    """Confidence-weighted means of the points in M voxels, sorted by scene and cell (x, y, z).

    Attributes:
        grid: ``[M, 3]`` int64 cells.
        batch: ``[M]`` int64 scene index.
        count: ``[M]`` int64 number of points.
        weight: ``[M]`` float64 sum of the points' confidences.
        confidence: ``[M]`` the smallest of them.
        features: ``[M, C]`` mean feature.
        means: ``[M, 6]`` mean position relative to the cell centre, in cells, and mean colour.
        moments: ``[M, 22]`` second moments about these means
            (:func:`vg2gt.method.additions.point_moments.pool_point_moments`); None unless requested.
    """

    grid: Tensor
    batch: Tensor
    count: Tensor
    weight: Tensor
    confidence: Tensor
    features: Tensor
    means: Tensor
    moments: Tensor | None

    def __len__(self) -> int:
        return len(self.grid)

    def rows(self, rows: Tensor | slice) -> PooledVoxels:
        """Returns some of the voxels; ``rows`` must keep their order."""
        return self.map(lambda tensor: tensor[rows])

    def plan(self) -> VoxelPlan:
        """Returns the voxels as a plan without points."""
        none = self.grid.new_zeros(0)
        return VoxelPlan(self.grid, self.batch, none, none, self.count, none)


def merge(parts: Sequence[PooledVoxels]) -> PooledVoxels:
    """Merges the voxels of all parts; up to rounding, as if all points had been pooled at once.

    Sums are in float64 and in the order of the parts, so the same parts in the same order give the same bits. A voxel
    of a single part is unchanged.

    Args:
        parts: at least one; all with the same feature width, and either all or none with moments.
    """
    joined = concatenate(parts)
    keys, order = torch.sort(mixed_radix_keys(joined.grid, joined.batch)[0], stable=True)
    lengths = torch.unique_consecutive(keys, return_counts=True)[1]
    first = order[lengths.cumsum(0) - lengths]
    if len(first) == len(joined):
        return joined.rows(order)

    def reduced(values: Tensor, how: str = "sum") -> Tensor:
        return torch.segment_reduce(values[order].contiguous(), how, lengths=lengths, unsafe=True)

    total = reduced(joined.weight)

    def mean(values: Tensor) -> Tensor:
        return reduced(joined.weight[:, None] * values.double()) / total[:, None]

    means = mean(joined.means)
    moments = joined.moments
    if moments is not None:  # about the merged means: raw moments minus products of means
        raw = torch.cat((moments[:, :18].double() + _products(joined.means.double()), moments[:, 18:].double()), 1)
        raw = mean(raw)
        moments = torch.cat((raw[:, :18] - _products(means), raw[:, 18:]), 1).to(moments.dtype)
    merged = PooledVoxels(
        grid=joined.grid[first],
        batch=joined.batch[first],
        count=reduced(joined.count.double()).long(),
        weight=total,
        confidence=reduced(joined.confidence, "min"),
        features=mean(joined.features).to(joined.features.dtype),
        means=means.to(joined.means.dtype),
        moments=moments,
    )
    alone = lengths == 1
    kept = joined.rows(first[alone])
    for each in fields(PooledVoxels):
        if getattr(merged, each.name) is not None:
            getattr(merged, each.name)[alone] = getattr(kept, each.name)
    return merged


def concatenate(parts: Sequence[PooledVoxels]) -> PooledVoxels:
    """Concatenates the voxels of all parts."""
    columns = ([getattr(part, each.name) for part in parts] for each in fields(PooledVoxels))
    return PooledVoxels(*(None if values[0] is None else torch.cat(values) for values in columns))  # pyright: ignore


def _products(means: Tensor) -> Tensor:
    """Returns ``[M, 18]``: position ``[3]`` times position and colour ``[6]``."""
    return (means[:, :3, None] * means[:, None]).flatten(1)
