"""The compiled passes of :mod:`vg2gt.method.additions.voxel_normals`."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from vg2gt.kernels.compiled import kernel
from vg2gt.kernels.compiled_math import exp
from vg2gt.kernels.threads import over_voxels

I1, I2, I3, I4, I5, I8, I9 = (np.uintp(number) for number in (1, 2, 3, 4, 5, 8, 9))  # unsigned: no negative indices


def facing_compiled(spread: Tensor, facing: Tensor, prior: float) -> Tensor:
    """Returns directions ``[M, 3]`` of least variance in ``spread`` ``[M, 3, 3]``, towards ``facing`` ``[M, 3]``."""
    normal = facing.new_empty(facing.shape)
    arrays = [values.detach().flatten().numpy() for values in (spread, facing, normal)]
    over_voxels(len(normal), lambda first, last: _face(*arrays, prior, first, last))
    return normal


@kernel(fastmath={"contract", "nsz", "arcp"}, error_model="numpy", nogil=True)
def _face(spread, facing, normal, prior, first, last):
    """Writes the normals of voxels ``first .. last - 1``, by the steps of ``smallest_eigenvector`` in float64.

    The smallest eigenvalue is ``mean - (1 + t) radius``. ``t^2 (t + 3)`` is known; Newton's method finds ``t``.
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
        part = 1.0 + root * (0.034 * root - 0.154)  # t / root, error 0.0012; after two steps 3e-13
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


def spread_around(
    keys: Tensor, columns: Tensor, counts: Tensor, spread: Tensor, normal: Tensor, offset: Tensor, same_surface: float
) -> Tensor:
    """Returns covariances ``[M, 3, 3]`` of the points in every voxel and its 26 neighbours; see the method's reference.

    ``keys`` ``[M]`` are the cells' keys, ascending. ``columns`` ``[9]`` are the offsets from a cell's key to those of
    the first cells of the nine columns around it.
    """
    above = keys.new_full((1,), torch.iinfo(keys.dtype).max)  # a sentinel that ends the scan of the keys
    around = torch.empty_like(spread, memory_format=torch.contiguous_format)
    inputs = (torch.cat((keys, above)), columns, counts, spread, normal, offset, around)
    arrays = [values.detach().contiguous().numpy() for values in inputs]
    sharpness = np.float32(math.sqrt(0.5) / same_surface)
    over_voxels(len(keys), lambda first, last: _spread_around(*arrays, np.empty(9, np.uintp), sharpness, first, last))
    return around


@kernel(fastmath={"contract", "nsz", "arcp"}, error_model="numpy", nogil=True)
def _spread_around(keys, columns, counts, spread, normal, offset, around, starts, sharpness, first, last):
    """:func:`spread_around` of voxels ``first .. last - 1``; ``keys`` ``[M + 1]`` end with a sentinel.

    The cells of a column have consecutive keys. As the voxels' keys ascend, so do those of each column.
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
