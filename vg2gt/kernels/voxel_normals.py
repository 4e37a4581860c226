"""The compiled pass of :mod:`vg2gt.method.additions.voxel_normals`."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from vg2gt.kernels.compiled import kernel
from vg2gt.kernels.compiled_math import exp
from vg2gt.kernels.threads import over_voxels

I1 = np.uintp(1)  # unsigned: no negative indices


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
