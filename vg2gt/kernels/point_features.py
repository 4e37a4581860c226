"""The compiled pass of :func:`vg2gt.method.fine.pool_point_features`."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from vg2gt.kernels.compiled import kernel
from vg2gt.kernels.compiled_math import gelu
from vg2gt.kernels.threads import over_voxels, parallel_for

PARTS = 16  # parts of the voxels; weight gradients are summed per part, in the same order for any number of threads


class PooledFeatures(torch.autograd.Function):
    """Compiled pooling; the backward pass recomputes the features instead of keeping them."""

    @staticmethod
    def forward(
        ctx: Any, dense: Tensor, offset: Tensor, weight: Tensor, confidence: Tensor,
        order: Tensor, starts: Tensor, counts: Tensor, voxel_of: Tensor,
    ) -> Tensor:  # fmt: skip
        """Returns means ``[M, C]`` over each voxel's points, as listed by a :class:`vg2gt.method.grid.VoxelPlan`."""
        inputs = [tensor.detach().contiguous() for tensor in (dense, offset, weight.t(), confidence)]
        voxels, ends = len(starts), starts + counts
        mean, total = dense.new_empty(voxels, dense.shape[1]), dense.new_empty(voxels)
        arrays = [tensor.numpy() for tensor in (*inputs, order, starts, ends, mean, total)]
        over_voxels(voxels, lambda first, last: _pool(*arrays, first, last))
        ctx.save_for_backward(*inputs, mean, total)
        ctx.plan = (order, starts, ends, voxel_of)
        return mean

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore
        """Returns gradients of the dense features, offsets, weight and confidence."""
        dense, offset, weight, confidence, mean, total = ctx.saved_tensors
        order, starts, ends, voxel_of = ctx.plan
        grad = grad_outputs[0].contiguous()
        along_mean = (grad * mean).sum(-1)
        gradients = [torch.empty_like(dense), torch.empty_like(offset), torch.empty_like(confidence)]
        if len(order) < len(dense):
            left_out = (voxel_of < 0).nonzero().squeeze(1)
            for gradient in gradients:
                gradient.index_fill_(0, left_out, 0)
        of_weight = dense.new_zeros(PARTS, *weight.shape)
        inputs = (dense, offset, weight, confidence, order, starts, ends, total)
        arrays = [tensor.numpy() for tensor in (*inputs, grad, along_mean, *gradients, of_weight)]
        parallel_for(_parts(len(starts)), lambda part: _pool_backward(*arrays, *part))
        of_dense, of_offset, of_confidence = gradients
        return of_dense, of_offset, of_weight.sum(0).t(), of_confidence, None, None, None, None


def _parts(voxels: int) -> list[tuple[int, int, int]]:
    """Returns index, first voxel and end of every part."""
    bounds = [voxels * part // PARTS for part in range(PARTS + 1)]
    return list(zip(range(PARTS), bounds[:-1], bounds[1:], strict=True))


@kernel(fastmath={"contract", "nsz", "arcp"}, error_model="numpy", nogil=True)
def _pool(dense, offset, weight, confidence, order, starts, ends, mean, total, first, last):
    """Writes means and summed confidences of voxels ``first .. last - 1``; ``weight`` is ``[3, C]``."""
    channels = dense.shape[1]
    for voxel in range(first, last):
        for c in range(channels):
            mean[voxel, c] = 0
        sum_of_weights = np.float32(0)
        for place in range(starts[voxel], ends[voxel]):
            point = np.uintp(order[place])
            x, y, z, n = offset[point, 0], offset[point, 1], offset[point, 2], confidence[point]
            sum_of_weights += n
            for c in range(channels):
                mean[voxel, c] += n * gelu(dense[point, c] + x * weight[0, c] + y * weight[1, c] + z * weight[2, c])[0]
        total[voxel] = sum_of_weights
        share = np.float32(1) / sum_of_weights
        for c in range(channels):
            mean[voxel, c] *= share


@kernel(fastmath={"contract", "nsz", "arcp", "reassoc"}, error_model="numpy", nogil=True)
def _pool_backward(
    dense, offset, weight, confidence, order, starts, ends, total,
    grad, along_mean, of_dense, of_offset, of_confidence, of_weight, part, first, last,
):  # fmt: skip
    """Writes the gradients at the points of voxels ``first .. last - 1``; sums that of the weight per part."""
    channels = dense.shape[1]
    for voxel in range(first, last):
        inverse = np.float32(1) / total[voxel]
        for place in range(starts[voxel], ends[voxel]):
            point = np.uintp(order[place])
            x, y, z = offset[point, 0], offset[point, 1], offset[point, 2]
            share = confidence[point] * inverse
            along = of_x = of_y = of_z = np.float32(0)
            for c in range(channels):
                value, slope = gelu(dense[point, c] + x * weight[0, c] + y * weight[1, c] + z * weight[2, c])
                along += value * grad[voxel, c]
                change = share * grad[voxel, c] * slope
                of_dense[point, c] = change
                of_x += change * weight[0, c]
                of_y += change * weight[1, c]
                of_z += change * weight[2, c]
                of_weight[part, 0, c] += change * x
                of_weight[part, 1, c] += change * y
                of_weight[part, 2, c] += change * z
            of_offset[point, 0], of_offset[point, 1], of_offset[point, 2] = of_x, of_y, of_z
            of_confidence[point] = (along - along_mean[voxel]) * inverse
