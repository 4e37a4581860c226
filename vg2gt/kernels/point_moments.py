"""The compiled pass of :func:`vg2gt.method.additions.point_moments.pool_point_moments`."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from vg2gt.kernels.compiled import kernel
from vg2gt.kernels.threads import over_voxels

Moments = tuple[Tensor, Tensor, Tensor, Tensor]


def moments_compiled(
    values: Tensor, depth: Tensor, confidence: Tensor, views: Tensor, means: Tensor,
    order: Tensor, starts: Tensor, counts: Tensor,
) -> Moments:  # fmt: skip
    """Returns second moments about the means; see :func:`vg2gt.method.additions.point_moments.pool_point_moments`."""
    inputs = [tensor.detach().contiguous() for tensor in (values, depth, confidence, views, means)]
    voxels = len(starts)
    found = tuple(values.new_empty(voxels, *shape) for shape in ((3, 3), (3, 3), (3,), ()))
    places = (order, starts, starts + counts)
    arrays = [tensor.numpy() for tensor in (*inputs, *places, *found)]
    over_voxels(voxels, lambda first, last: _pool(*arrays, first, last))
    spread, cross, eye, pixel = found
    return spread, cross, eye, pixel


@kernel(fastmath={"contract", "nsz", "arcp"}, error_model="numpy", nogil=True)
def _pool(values, depth, confidence, views, means, order, starts, ends, spread, cross, eye, pixel, first, last):
    """Writes the moments of voxels ``first .. last - 1``; x, y, z and r, g, b are differences from the means."""
    views_a_point = len(views) / max(len(values), 1)
    for voxel in range(np.uintp(first), np.uintp(last)):
        mean_x, mean_y, mean_z = means[voxel, 0], means[voxel, 1], means[voxel, 2]
        mean_r, mean_g, mean_b = means[voxel, 3], means[voxel, 4], means[voxel, 5]
        total = eye_x = eye_y = eye_z = side = np.float32(0)
        xx = xy = xz = yy = yz = zz = np.float32(0)
        xr = xg = xb = yr = yg = yb = zr = zg = zb = np.float32(0)
        for place in range(np.uintp(starts[voxel]), np.uintp(ends[voxel])):
            point = np.uintp(order[place])
            view = np.uintp((point + 0.5) * views_a_point)  # faster than an integer division
            n = confidence[point]
            total += n
            eye_x += n * views[view, 0]
            eye_y += n * views[view, 1]
            eye_z += n * views[view, 2]
            side += n * depth[point] / views[view, 3]
            x, y, z = values[point, 0] - mean_x, values[point, 1] - mean_y, values[point, 2] - mean_z
            r, g, b = values[point, 3] - mean_r, values[point, 4] - mean_g, values[point, 5] - mean_b
            nx, ny, nz = n * x, n * y, n * z
            xx += nx * x
            xy += nx * y
            xz += nx * z
            yy += ny * y
            yz += ny * z
            zz += nz * z
            xr += nx * r
            xg += nx * g
            xb += nx * b
            yr += ny * r
            yg += ny * g
            yb += ny * b
            zr += nz * r
            zg += nz * g
            zb += nz * b
        share = np.float32(1) / total
        spread[voxel, 0, 0], spread[voxel, 1, 1], spread[voxel, 2, 2] = xx * share, yy * share, zz * share
        spread[voxel, 0, 1] = spread[voxel, 1, 0] = xy * share
        spread[voxel, 0, 2] = spread[voxel, 2, 0] = xz * share
        spread[voxel, 1, 2] = spread[voxel, 2, 1] = yz * share
        cross[voxel, 0, 0], cross[voxel, 0, 1], cross[voxel, 0, 2] = xr * share, xg * share, xb * share
        cross[voxel, 1, 0], cross[voxel, 1, 1], cross[voxel, 1, 2] = yr * share, yg * share, yb * share
        cross[voxel, 2, 0], cross[voxel, 2, 1], cross[voxel, 2, 2] = zr * share, zg * share, zb * share
        eye[voxel, 0], eye[voxel, 1], eye[voxel, 2] = eye_x * share, eye_y * share, eye_z * share
        pixel[voxel] = side * share
