"""Normals of the surface through each voxel, from its own points or from those of the cells around it (ours).

A cell of a few pixels holds pieces of the surfaces that several views saw, one above the other by what their depths
differ, so the spread of its own points says little of how the surface runs. Over three cells it shows.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import torch
from torch import Tensor

from vg2gt.geometry.symmetric import FULL, UPPER, facing_normals
from vg2gt.types import VoxelMoments
from vg2gt.voxels.grid import VoxelPlan, mixed_radix_keys

SAME_SURFACE = 0.5  # cells off the tangent plane at which a neighbour's points count e^-1/2


@torch.no_grad()
def with_normals(moments: VoxelMoments, offset: Tensor, plan: VoxelPlan, kernel: int) -> VoxelMoments:
    """The moments with the normals of voxels.

    With a kernel of 3 a normal is that of all points in 27 cells, weighted by how near their cell's mean lies to the
    voxel's own tangent plane: a plane fitted to one surface, so that edges stay.

    Args:
        moments: second moments of M voxels.
        offset: ``[M, 3]`` mean positions from the cells' centres, in cells.
        plan: which cells they are.
        kernel: cells a side that count, 1 or 3.
    """
    own = facing_normals(moments.spread, moments.facing)
    if kernel == 1 or not len(plan):
        return replace(moments, normal=own)
    spread = _spread_around(moments.spread, own, offset, plan, kernel)
    return replace(moments, normal=facing_normals(spread, moments.facing))


def _spread_around(spread: Tensor, normal: Tensor, offset: Tensor, plan: VoxelPlan, kernel: int) -> Tensor:
    """``[M, 3, 3]`` covariance of the points of a voxel and its neighbours."""
    radius = kernel // 2
    keys, steps = mixed_radix_keys(plan.grid, plan.batch, margin=radius)  # ascending, as the plan's voxels are
    count, inner = plan.counts.to(spread.dtype), spread[:, UPPER[0], UPPER[1]]
    sums = spread.new_zeros(len(plan), 10)  # weight, place (3), products of places (6)
    for step in itertools.product(range(-radius, radius + 1), repeat=3):
        wanted = keys + sum(s * k for s, k in zip(step, steps, strict=True))
        row = torch.searchsorted(keys, wanted).clamp_(max=len(keys) - 1)
        place = offset.index_select(0, row) - offset + spread.new_tensor(step)  # [M, 3]
        height = (place * normal).sum(-1) / SAME_SURFACE
        weight = count.index_select(0, row) * (keys.index_select(0, row) == wanted) * torch.exp(-height.square() / 2)
        products = inner.index_select(0, row) + place[:, UPPER[0]] * place[:, UPPER[1]]
        sums += weight[:, None] * torch.cat((torch.ones_like(place[:, :1]), place, products), -1)
    mean, products = (sums[:, 1:] / sums[:, :1]).split((3, 6), -1)
    around = products - mean[:, UPPER[0]] * mean[:, UPPER[1]]
    return around[:, FULL].unflatten(-1, (3, 3))
