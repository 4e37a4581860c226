"""Normals of the surface through each voxel, from its own points or from those of the cells around it (ours).

A cell of a few pixels holds pieces of the surfaces that several views saw, one above the other by what their depths
differ, so the spread of its own points says little of how the surface runs. Over three cells it shows.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import torch
from torch import Tensor

from vg2gt.geometry.symmetric import FULL, UPPER, smallest_eigenvector
from vg2gt.io.compiled import kernel
from vg2gt.io.compiled_math import exp
from vg2gt.voxels.grid import VoxelPlan, mixed_radix_keys
from vg2gt.voxels.passes import compilable, over_voxels

FACING_PRIOR = 1e-4  # cells^2: without evidence a surface faces its cameras
SAME_SURFACE = 0.5  # cells off the tangent plane at which a neighbour's points count e^-1/2
COLUMNS = tuple(itertools.product((-1, 0, 1), repeat=2))  # steps along x and y to the nine columns around a cell
I1, I2, I3, I4, I5, I8, I9 = (np.uintp(number) for number in (1, 2, 3, 4, 5, 8, 9))  # unsigned: no index from the end


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
        ``[M, 3]`` unit vectors; compiled for float32 on a CPU.
    """
    own = facing_normals(spread, facing)
    if kernel == 1 or not len(plan):
        return own
    spread_around = around_compiled if compilable(spread, own, offset) else around_reference
    return facing_normals(spread_around(spread, own, offset, plan), facing)


def facing_normals(spread: Tensor, facing: Tensor) -> Tensor:
    """Directions of least spread, on the side of the cameras.

    Args:
        spread: ``[M, 3, 3]`` covariances of positions, in cells^2.
        facing: ``[M, 3]`` unit vectors towards the cameras; the normal where the spread knows none.

    Returns:
        ``[M, 3]`` unit vectors; compiled for float32 on a CPU.
    """
    return (facing_compiled if compilable(spread, facing) else facing_reference)(spread, facing)


def facing_reference(spread: Tensor, facing: Tensor) -> Tensor:
    """:func:`facing_normals` in plain torch."""
    eye = torch.eye(3, dtype=spread.dtype, device=spread.device)
    # A little variance everywhere but along the line of sight: with nothing else known, that line is the normal.
    prior = FACING_PRIOR * (eye - facing[:, :, None] * facing[:, None])
    normal = smallest_eigenvector(spread + prior, facing)
    return torch.where((normal * facing).sum(-1, keepdim=True) < 0, -normal, normal)


def facing_compiled(spread: Tensor, facing: Tensor) -> Tensor:
    """:func:`facing_normals` on a CPU."""
    normal = facing.new_empty(facing.shape)
    arrays = [values.detach().flatten().numpy() for values in (spread, facing, normal)]
    over_voxels(len(normal), lambda first, last: _face(*arrays, FACING_PRIOR, first, last))
    return normal


@kernel(fastmath={"contract", "nsz", "arcp"}, error_model="numpy", nogil=True)
def _face(spread, facing, normal, prior, first, last):
    """Normals of voxels ``first`` to ``last``, by the steps of ``smallest_eigenvector`` and in float64 like it.

    The least root of the characteristic cubic needs no cosine here: it lies ``1 + t`` radii below the mean, where
    ``t^2 (t + 3)`` is known, and Newton's method finds ``t``. The arrays are flat, which lets the loop be vectorised.
    """
    for voxel in range(np.uintp(first), np.uintp(last)):
        row, cell = I3 * voxel, I9 * voxel
        u, v, w = np.float64(facing[row]), np.float64(facing[row + I1]), np.float64(facing[row + I2])
        xx = spread[cell] + prior * (1.0 - u * u)
        yy = spread[cell + I4] + prior * (1.0 - v * v)
        zz = spread[cell + I8] + prior * (1.0 - w * w)
        xy = spread[cell + I1] - prior * (u * v)
        xz = spread[cell + I2] - prior * (u * w)
        yz = spread[cell + I5] - prior * (v * w)
        largest = max(max(max(abs(xx), abs(yy)), max(abs(zz), abs(xy))), max(abs(xz), abs(yz)))
        scale = 1.0 / max(largest, 1e-300)
        xx, yy, zz, xy, xz, yz = xx * scale, yy * scale, zz * scale, xy * scale, xz * scale, yz * scale
        mean = (xx + yy + zz) / 3.0
        xx, yy, zz = xx - mean, yy - mean, zz - mean
        square = (xx * xx + yy * yy + zz * zz + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0
        radius = math.sqrt(square)
        determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
        known = min(max(2.0 - determinant / max(square * radius, 1e-300), 0.0), 4.0)  # t^2 (t + 3)
        root = math.sqrt(known / 3.0)
        part = 1.0 + root * (0.034 * root - 0.154)  # t / root, within 0.0012; two steps leave 3e-13
        for _ in range(2):
            part -= ((root * part + 3.0) * part * part - 3.0) / (3.0 * part * (root * part + 2.0))
        below = radius * (1.0 + root * part)
        xx, yy, zz = xx + below, yy + below, zz + below
        nx, ny, nz = xy * yz - xz * yy, xz * xy - xx * yz, xx * yy - xy * xy
        longest = nx * nx + ny * ny + nz * nz
        cx, cy, cz = xy * zz - xz * yz, xz * xz - xx * zz, xx * yz - xy * xz
        length = cx * cx + cy * cy + cz * cz
        if length > longest:
            nx, ny, nz, longest = cx, cy, cz, length
        cx, cy, cz = yy * zz - yz * yz, yz * xz - xy * zz, xy * yz - yy * xz
        length = cx * cx + cy * cy + cz * cz
        if length > longest:
            nx, ny, nz, longest = cx, cy, cz, length
        if longest > 1e-12:
            share = 1.0 / math.sqrt(longest)
            if nx * u + ny * v + nz * w < 0.0:
                share = -share
            nx, ny, nz = nx * share, ny * share, nz * share
        else:
            nx, ny, nz = u, v, w
        normal[row], normal[row + I1], normal[row + I2] = nx, ny, nz


def around_reference(spread: Tensor, normal: Tensor, offset: Tensor, plan: VoxelPlan) -> Tensor:
    """Covariances of the points of every voxel and of the 26 around it, in plain torch.

    Args:
        spread: ``[M, 3, 3]`` covariances of the points' positions, in cells^2.
        normal: ``[M, 3]`` of each voxel's own tangent plane.
        offset: ``[M, 3]`` mean positions from the cells' centres, in cells.
        plan: which cells they are.

    Returns:
        ``[M, 3, 3]``, weighted by the number of a cell's points and by how near the tangent plane their mean lies.
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


def around_compiled(spread: Tensor, normal: Tensor, offset: Tensor, plan: VoxelPlan) -> Tensor:
    """:func:`around_reference` on a CPU, without a list of pairs."""
    keys, (step_x, step_y, _) = mixed_radix_keys(plan.grid, plan.batch, margin=1)  # ascending, as the plan's voxels are
    columns = torch.tensor([i * step_x + j * step_y - 1 for i, j in COLUMNS])
    above = keys.new_full((1,), torch.iinfo(keys.dtype).max)  # all cells: a walk along the keys stops there
    around = torch.empty_like(spread, memory_format=torch.contiguous_format)
    inputs = (torch.cat((keys, above)), columns, plan.counts, spread, normal, offset, around)
    arrays = [values.detach().contiguous().numpy() for values in inputs]
    sharpness = np.float32(math.sqrt(0.5) / SAME_SURFACE)
    over_voxels(len(keys), lambda first, last: _spread_around(*arrays, np.empty(9, np.uintp), sharpness, first, last))
    return around


@kernel(fastmath={"contract", "nsz", "arcp"}, error_model="numpy", nogil=True)
def _spread_around(keys, columns, counts, spread, normal, offset, around, starts, sharpness, first, last):
    """Cells of a column have keys in a row, and with the voxels' keys those of their columns ascend.

    Args:
        keys: ``[M + 1]`` of the voxels, then a number above all.
        columns: ``[9]`` what leads from a voxel's key to that of a column's first cell.
        counts: ``[M]`` points in each voxel.
        spread: ``[M, 3, 3]``.
        normal: ``[M, 3]``.
        offset: ``[M, 3]``.
        around: ``[M, 3, 3]``, the result.
        starts: ``[9]``, overwritten.
        sharpness: one over the cells off the tangent plane at which points count 1 / e.
        first: voxel to begin with.
        last: voxel to end before.
    """
    one = np.float32(1)
    for column in range(9):
        lowest, low, high = keys[first] + columns[column], 0, len(keys)
        while low < high:
            middle = (low + high) // 2
            if keys[middle] < lowest:
                low = middle + 1
            else:
                high = middle
        starts[column] = low
    for voxel in range(np.uintp(first), np.uintp(last)):
        nx, ny, nz = normal[voxel, 0] * sharpness, normal[voxel, 1] * sharpness, normal[voxel, 2] * sharpness
        total = mean_x = mean_y = mean_z = np.float32(0)
        xx = xy = xz = yy = yz = zz = np.float32(0)
        column = np.uintp(0)
        for i in range(-1, 2):
            from_x = np.float32(i) - offset[voxel, 0]
            for j in range(-1, 2):
                from_y, from_z = np.float32(j) - offset[voxel, 1], -one - offset[voxel, 2]
                lowest = keys[voxel] + columns[column]
                other = starts[column]
                while keys[other] < lowest:
                    other += I1
                starts[column] = other
                column += I1
                while keys[other] < lowest + 3:
                    x = offset[other, 0] + from_x
                    y = offset[other, 1] + from_y
                    z = offset[other, 2] + (from_z + np.float32(keys[other] - lowest))
                    height = x * nx + y * ny + z * nz
                    weight = np.float32(counts[other]) * exp(-height * height)
                    total += weight
                    mean_x += weight * x
                    mean_y += weight * y
                    mean_z += weight * z
                    xx += weight * (spread[other, 0, 0] + x * x)
                    xy += weight * (spread[other, 0, 1] + x * y)
                    xz += weight * (spread[other, 0, 2] + x * z)
                    yy += weight * (spread[other, 1, 1] + y * y)
                    yz += weight * (spread[other, 1, 2] + y * z)
                    zz += weight * (spread[other, 2, 2] + z * z)
                    other += I1
        share = one / total
        x, y, z = mean_x * share, mean_y * share, mean_z * share
        around[voxel, 0, 0] = xx * share - x * x
        around[voxel, 1, 1] = yy * share - y * y
        around[voxel, 2, 2] = zz * share - z * z
        around[voxel, 0, 1] = around[voxel, 1, 0] = xy * share - x * y
        around[voxel, 0, 2] = around[voxel, 2, 0] = xz * share - x * z
        around[voxel, 1, 2] = around[voxel, 2, 1] = yz * share - y * z


def _pairs(plan: VoxelPlan) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rows ``[P]`` of voxels, sorted, those of a cell of their 3x3x3 each, its shift ``[P, 3]``, and pairs a voxel."""
    keys, (step_x, step_y, _) = mixed_radix_keys(plan.grid, plan.batch, margin=1)  # ascending, as the plan's voxels are
    columns = keys.new_tensor(COLUMNS)  # [9, 2]
    lowest = keys[:, None] + columns @ keys.new_tensor([step_x, step_y]) - 1  # [M, 9]: the column's first cell
    # The cells of a column have keys in a row, so its voxels do.
    row = torch.searchsorted(keys, lowest)[..., None] + torch.arange(3, device=keys.device)  # [M, 9, 3]
    row = row.clamp_(max=len(keys) - 1)
    above = keys[row] - lowest[..., None]
    found = (above >= 0) & (above < 3) & (row.diff(dim=-1, prepend=row[..., :1] - 1) > 0)
    place = found.nonzero(as_tuple=True)
    voxel, column, _ = place
    return voxel, row[place], torch.cat((columns[column], above[place][:, None] - 1), -1), found.sum((1, 2))
