"""Normals of the surface through each voxel, from its own points or from those of the cells around it (ours).

A cell of a few pixels holds pieces of the surfaces that several views saw, one above the other by what their depths
differ, so the spread of its own points says little of how the surface runs. Over three cells it shows.
"""

from __future__ import annotations

import itertools

import numpy as np
import torch
from torch import Tensor

from vg2gt.geometry.symmetric import FULL, UPPER, smallest_eigenvector
from vg2gt.io.compiled import kernel
from vg2gt.voxels.grid import VoxelPlan, mixed_radix_keys

FACING_PRIOR = 1e-4  # cells^2: without evidence a surface faces its cameras
SAME_SURFACE = 0.5  # cells off the tangent plane at which a neighbour's points count e^-1/2


@torch.no_grad()
def surface_normals(spread: Tensor, facing: Tensor, offset: Tensor, plan: VoxelPlan, kernel: int) -> Tensor:
    """Normals of the surface through every voxel, on the side of the cameras.

    With a kernel of 3 a normal is that of all points in 27 cells, weighted by how near their cell's mean lies to the
    voxel's own tangent plane: a plane fitted to one surface, so that edges stay.

    Args:
        spread: ``[M, 3, 3]`` covariances of the points' positions, in cells^2.
        facing: ``[M, 3]`` unit vectors towards the cameras.
        offset: ``[M, 3]`` mean positions from the cells' centres, in cells.
        plan: which cells they are.
        kernel: cells a side that count, 1 or 3.

    Returns:
        ``[M, 3]`` unit vectors.
    """
    own = facing_normals(spread, facing)
    if kernel == 1 or not len(plan):
        return own
    return facing_normals(_spread_around(spread, own, offset, plan), facing)


def facing_normals(spread: Tensor, facing: Tensor) -> Tensor:
    """Directions of least spread, on the side of the cameras.

    Args:
        spread: ``[M, 3, 3]`` covariances of positions, in cells^2.
        facing: ``[M, 3]`` unit vectors towards the cameras; the normal where the spread knows none.

    Returns:
        ``[M, 3]`` unit vectors.
    """
    eye = torch.eye(3, dtype=spread.dtype, device=spread.device)
    # A little variance everywhere but along the line of sight: with nothing else known, that line is the normal.
    prior = FACING_PRIOR * (eye - facing[:, :, None] * facing[:, None])
    normal = smallest_eigenvector(spread + prior, facing)
    return torch.where((normal * facing).sum(-1, keepdim=True) < 0, -normal, normal)


def _spread_around(spread: Tensor, normal: Tensor, offset: Tensor, plan: VoxelPlan) -> Tensor:
    """``[M, 3, 3]`` covariance of the points of a voxel and its neighbours."""
    sums_around = sums_compiled if offset.device.type == "cpu" else sums_reference
    sums = sums_around(spread[:, UPPER[0], UPPER[1]], normal, offset, plan)
    mean, products = (sums[:, 1:] / sums[:, :1]).split((3, 6), -1)
    around = products - mean[:, UPPER[0]] * mean[:, UPPER[1]]
    return around[:, FULL].unflatten(-1, (3, 3))


def sums_reference(spread: Tensor, normal: Tensor, offset: Tensor, plan: VoxelPlan) -> Tensor:
    """Weighted sums over the 27 cells around every voxel, in plain torch.

    Args:
        spread: ``[M, 6]`` covariances of the points' positions, upper triangles, in cells^2.
        normal: ``[M, 3]`` of each voxel's own tangent plane.
        offset: ``[M, 3]`` mean positions from the cells' centres, in cells.
        plan: which cells they are.

    Returns:
        ``[M, 10]``: weight, position from the voxel's own mean, products of positions (upper triangle).
    """
    voxel, other, shift, lengths = _pairs(plan)
    x, y, z = (offset.index_select(0, other) - offset.index_select(0, voxel) + shift.to(offset.dtype)).unbind(-1)  # [P]
    height = (torch.stack((x, y, z), -1) * normal.index_select(0, voxel)).sum(-1) / SAME_SURFACE
    weight = plan.counts.to(offset.dtype).index_select(0, other) * torch.exp(-height.square() / 2)
    products = spread.index_select(0, other) + torch.stack((x * x, x * y, x * z, y * y, y * z, z * z), -1)  # [P, 6]
    weighted = torch.cat((torch.ones_like(x)[:, None], torch.stack((x, y, z), -1), products), -1) * weight[:, None]
    return torch.segment_reduce(weighted, "sum", lengths=lengths, unsafe=True)


def sums_compiled(spread: Tensor, normal: Tensor, offset: Tensor, plan: VoxelPlan) -> Tensor:
    """:func:`sums_reference` on a CPU, without a list of pairs."""
    keys, (step_x, step_y, _) = mixed_radix_keys(plan.grid, plan.batch, margin=1)  # ascending, as the plan's voxels are
    sums = offset.new_zeros(len(offset), 10)
    arrays = [values.contiguous().numpy() for values in (keys, plan.counts, spread, normal, offset)]
    _add_neighbors(*arrays, step_x, step_y, SAME_SURFACE, sums.numpy())
    return sums


@kernel(fastmath={"contract", "nsz", "arcp"}, error_model="numpy", nogil=True)
def _add_neighbors(keys, counts, spread, normal, offset, step_x, step_y, same_surface, sums):
    """The cells of a column have keys in a row, and with the voxels' keys those of their columns ascend."""
    for i in range(-1, 2):
        for j in range(-1, 2):
            first = 0
            for voxel in range(len(keys)):
                lowest = keys[voxel] + i * step_x + j * step_y - 1
                while first < len(keys) and keys[first] < lowest:
                    first += 1
                other = first
                while other < len(keys) and keys[other] < lowest + 3:
                    x = offset[other, 0] - offset[voxel, 0] + i
                    y = offset[other, 1] - offset[voxel, 1] + j
                    z = offset[other, 2] - offset[voxel, 2] + (keys[other] - lowest - 1)
                    height = (x * normal[voxel, 0] + y * normal[voxel, 1] + z * normal[voxel, 2]) / same_surface
                    weight = counts[other] * np.exp(-height * height / 2)
                    sums[voxel, 0] += weight
                    sums[voxel, 1] += weight * x
                    sums[voxel, 2] += weight * y
                    sums[voxel, 3] += weight * z
                    sums[voxel, 4] += weight * (spread[other, 0] + x * x)
                    sums[voxel, 5] += weight * (spread[other, 1] + x * y)
                    sums[voxel, 6] += weight * (spread[other, 2] + x * z)
                    sums[voxel, 7] += weight * (spread[other, 3] + y * y)
                    sums[voxel, 8] += weight * (spread[other, 4] + y * z)
                    sums[voxel, 9] += weight * (spread[other, 5] + z * z)
                    other += 1


def _pairs(plan: VoxelPlan) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rows ``[P]`` of voxels, sorted, those of a cell of their 3x3x3 each, its shift ``[P, 3]``, and pairs a voxel."""
    keys, (step_x, step_y, _) = mixed_radix_keys(plan.grid, plan.batch, margin=1)  # ascending, as the plan's voxels are
    columns = keys.new_tensor(list(itertools.product((-1, 0, 1), repeat=2)))  # [9, 2]
    lowest = keys[:, None] + columns @ keys.new_tensor([step_x, step_y]) - 1  # [M, 9]: the column's first cell
    # The cells of a column have keys in a row, so its voxels do.
    row = torch.searchsorted(keys, lowest)[..., None] + torch.arange(3, device=keys.device)  # [M, 9, 3]
    row = row.clamp_(max=len(keys) - 1)
    above = keys[row] - lowest[..., None]
    found = (above >= 0) & (above < 3) & (row.diff(dim=-1, prepend=row[..., :1] - 1) > 0)
    place = found.nonzero(as_tuple=True)
    voxel, column, _ = place
    return voxel, row[place], torch.cat((columns[column], above[place][:, None] - 1), -1), found.sum((1, 2))
