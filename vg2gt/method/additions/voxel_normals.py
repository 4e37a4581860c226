"""Surface normal of each voxel, from its own points or from those of the 3x3x3 cells around it (ours).

A cell a few pixels wide contains stacked fragments of the surfaces of several views. Their common surface only becomes
visible over three cells.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import torch
from torch import Tensor

from vg2gt.geometry.symmetric import FULL, UPPER, smallest_eigenvector
from vg2gt.kernels.spread import spread_around
from vg2gt.kernels.threads import compilable, over_voxels
from vg2gt.method.grid import VoxelPlan, mixed_radix_keys

FACING_PRIOR = 1e-4  # cells^2; without evidence, a surface faces its cameras
SAME_SURFACE = 0.5  # cells; distance from the tangent plane at which a neighbour's points have weight e^-1/2
COLUMNS = tuple(itertools.product((-1, 0, 1), repeat=2))  # steps along x and y to the nine columns around a cell


@torch.no_grad()
def surface_normals(spread: Tensor, facing: Tensor, offset: Tensor, plan: VoxelPlan, kernel: int) -> Tensor:
    """Computes the surface normal of every voxel, facing the cameras.

    With a kernel of 3, a normal is fitted to the points of 27 cells. Cells are weighted by the distance of their mean
    from the voxel's own tangent plane, so that the fit follows one surface and edges are preserved.

    Args:
        spread: ``[M, 3, 3]`` covariances of the points' positions, in cells^2.
        facing: ``[M, 3]`` unit vectors towards the cameras.
        offset: ``[M, 3]`` mean positions relative to the cell centres, in cells.
        plan: the voxels.
        kernel: edge length of the neighbourhood in cells, 1 or 3.

    Returns:
        ``[M, 3]`` unit vectors.
    """
    own = facing_normals(spread, facing)
    if kernel == 1 or not len(plan):
        return own
    around = _around_compiled if compilable(spread, own, offset) else _around_reference
    return facing_normals(around(spread, own, offset, plan), facing)


def facing_normals(spread: Tensor, facing: Tensor) -> Tensor:
    """Returns the directions of least spread, facing the cameras.

    Args:
        spread: ``[M, 3, 3]`` covariances of positions, in cells^2.
        facing: ``[M, 3]`` unit vectors towards the cameras; used as the normal where the spread determines none.

    Returns:
        ``[M, 3]`` unit vectors.
    """
    sight = facing.double()
    eye = torch.eye(3, dtype=sight.dtype, device=sight.device)
    # a little variance perpendicular to the line of sight, which is then the normal where the spread determines none
    prior = FACING_PRIOR * (eye - sight[:, :, None] * sight[:, None])
    normal = smallest_eigenvector(spread.double() + prior, sight)
    return torch.where((normal * sight).sum(-1, keepdim=True) < 0, -normal, normal).to(facing.dtype)


def _around_reference(spread: Tensor, normal: Tensor, offset: Tensor, plan: VoxelPlan) -> Tensor:
    """Returns the covariances ``[M, 3, 3]`` of the points in the 3x3x3 cells around every voxel, in plain torch.

    Cells are weighted by their number of points, and by the distance of their mean from the voxel's own tangent plane.
    """
    voxel, other, shift, lengths = _pairs(plan)
    x, y, z = (offset.index_select(0, other) - offset.index_select(0, voxel) + shift.to(offset.dtype)).unbind(-1)  # [P]
    height = (torch.stack((x, y, z), -1) * normal.index_select(0, voxel)).sum(-1) / SAME_SURFACE
    weight = plan.counts.to(offset.dtype).index_select(0, other) * torch.exp(-height.square() / 2)
    upper = spread[:, UPPER[0], UPPER[1]].index_select(0, other)
    products = upper + torch.stack((x * x, x * y, x * z, y * y, y * z, z * z), -1)  # [P, 6]
    weighted = torch.cat((torch.ones_like(x)[:, None], torch.stack((x, y, z), -1), products), -1) * weight[:, None]
    sums = torch.segment_reduce(weighted, "sum", lengths=lengths, unsafe=True)
    mean, products = (sums[:, 1:] / sums[:, :1]).split((3, 6), -1)
    around = products - mean[:, UPPER[0]] * mean[:, UPPER[1]]
    return around[:, FULL].unflatten(-1, (3, 3))


def _around_compiled(spread: Tensor, normal: Tensor, offset: Tensor, plan: VoxelPlan) -> Tensor:
    """:func:`_around_reference` compiled for the CPU, without storing the pairs."""
    keys, (step_x, step_y, _) = mixed_radix_keys(plan.grid, plan.batch, margin=1)  # ascending, like the plan's voxels
    columns = torch.tensor([i * step_x + j * step_y - 1 for i, j in COLUMNS])
    above = keys.new_full((1,), torch.iinfo(keys.dtype).max)  # a sentinel that ends the scan of the keys
    around = torch.empty_like(spread, memory_format=torch.contiguous_format)
    inputs = (torch.cat((keys, above)), columns, plan.counts, spread, normal, offset, around)
    arrays = [values.detach().contiguous().numpy() for values in inputs]
    sharpness = np.float32(math.sqrt(0.5) / SAME_SURFACE)
    over_voxels(len(keys), lambda first, last: spread_around(*arrays, np.empty(9, np.uintp), sharpness, first, last))
    return around


def _pairs(plan: VoxelPlan) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pairs each voxel with its 3x3x3 cells: both rows ``[P]``, shifts ``[P, 3]``, and pairs per voxel ``[M]``."""
    keys, (step_x, step_y, _) = mixed_radix_keys(plan.grid, plan.batch, margin=1)  # ascending, like the plan's voxels
    columns = keys.new_tensor(COLUMNS)  # [9, 2]
    steps = (columns * keys.new_tensor([step_x, step_y])).sum(1)  # [9]; CUDA has no integer matrix product
    lowest = keys[:, None] + steps - 1  # [M, 9]: the column's first cell
    # the three cells of a column have consecutive keys, so their voxels have consecutive rows
    row = torch.searchsorted(keys, lowest)[..., None] + torch.arange(3, device=keys.device)  # [M, 9, 3]
    row = row.clamp_(max=len(keys) - 1)
    above = keys[row] - lowest[..., None]
    found = (above >= 0) & (above < 3) & (row.diff(dim=-1, prepend=row[..., :1] - 1) > 0)
    place = found.nonzero(as_tuple=True)
    voxel, column, _ = place
    return voxel, row[place], torch.cat((columns[column], above[place][:, None] - 1), -1), found.sum((1, 2))
