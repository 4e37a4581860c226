"""The compiled pass of :mod:`vg2gt.method.additions.voxel_normals`."""

from __future__ import annotations

import numpy as np

from vg2gt.kernels.compiled import kernel
from vg2gt.kernels.compiled_math import exp

_I1 = np.uintp(1)  # unsigned: no negative indices


@kernel(fastmath={"contract", "nsz", "arcp"}, error_model="numpy", nogil=True)
def spread_around(keys, columns, counts, spread, normal, offset, around, starts, sharpness, first, last):
    """Writes covariances ``[M, 3, 3]`` of the points in voxels ``first .. last - 1`` and their 26 neighbours.

    ``keys`` ``[M + 1]`` are the cells' keys, ascending, and a sentinel. ``columns`` ``[9]`` are the offsets from a
    cell's key to those of the first cells of the nine columns around it; ``starts`` ``[9]`` is scratch memory. The
    cells of a column have consecutive keys. As the voxels' keys ascend, so do those of each column.
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
                    other += _I1
                starts[column] = other
                column += _I1
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
                    other += _I1
        share = one / total
        x, y, z = mean_x * share, mean_y * share, mean_z * share
        around[voxel, 0, 0] = xx * share - x * x
        around[voxel, 1, 1] = yy * share - y * y
        around[voxel, 2, 2] = zz * share - z * z
        around[voxel, 0, 1] = around[voxel, 1, 0] = xy * share - x * y
        around[voxel, 0, 2] = around[voxel, 2, 0] = xz * share - x * z
        around[voxel, 1, 2] = around[voxel, 2, 1] = yz * share - y * z
