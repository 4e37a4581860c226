"""The compiled pass of :mod:`vg2gt.method.additions.point_moments`; it stores no product of a single point."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from vg2gt.kernels.compiled import kernel
from vg2gt.kernels.threads import over_voxels


def moments_in_one_pass(
    values: Tensor, depth: Tensor, confidence: Tensor, views: Tensor, means: Tensor,
    order: Tensor, starts: Tensor, counts: Tensor,
) -> Tensor:  # fmt: skip
    """Returns means ``[M, 22]`` over every voxel's points, in the order of the reference's products."""
    inputs = [tensor.detach().contiguous() for tensor in (values, depth, confidence, views, means)]
    found = values.new_zeros(len(starts), 22)
    arrays = [tensor.numpy() for tensor in (*inputs, order, starts, starts + counts, found)]
    over_voxels(len(starts), lambda first, last: _pool(*arrays, len(values) // len(views), first, last))
    return found


@kernel(fastmath={"contract", "nsz", "arcp"}, error_model="numpy", nogil=True)
def _pool(values, depth, confidence, views, means, order, starts, ends, found, per_view, first, last):
    """Adds the products of the points in voxels ``first .. last - 1`` to ``found``, which is zero."""
    for voxel in range(first, last):
        total = np.float32(0)
        for place in range(starts[voxel], ends[voxel]):
            point = np.uintp(order[place])
            view, n = point // np.uintp(per_view), confidence[point]
            total += n
            for i in range(3):
                apart = n * (values[point, i] - means[voxel, i])
                for j in range(6):
                    found[voxel, 6 * i + j] += apart * (values[point, j] - means[voxel, j])
                found[voxel, 18 + i] += n * views[view, i]
            found[voxel, 21] += n * depth[point] / views[view, 3]
        share = np.float32(1) / total
        for k in range(22):
            found[voxel, k] *= share
