"""Features of pixels pooled into voxels: ``sum n gelu(f + W o) / sum n``, plain and in one compiled pass.

f is a pixel's dense feature, o its place within the cell and n its confidence (paper, eqn voxelfeature). Written as
separate operations, four arrays of all pixels' features come and go; the compiled pass keeps none.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.io.compiled import kernel
from vg2gt.io.compiled_math import gelu
from vg2gt.io.threads import parallel_for
from vg2gt.voxels.grid import VoxelPlan, pool_mean, pool_mean_of_chunks
from vg2gt.voxels.passes import compilable, over_voxels

PARTS = 16  # of the voxels; their sums over all points are added in this order, whatever the number of threads


def pool_point_features(dense: Tensor, offset: Tensor, weight: Tensor, confidence: Tensor, plan: VoxelPlan) -> Tensor:
    """Confidence-weighted mean of the points' features in every voxel.

    Args:
        dense: ``[N, C]`` dense features of the pixels.
        offset: ``[N, 3]`` their places within their cells, in [-1/2, 1/2].
        weight: ``[C, 3]`` what a place adds to a feature.
        confidence: ``[N]`` > 0.
        plan: the voxels.

    Returns:
        ``[M, C]``, differentiable in all tensors; compiled where they are float32 on a CPU.
    """
    if len(plan) and compilable(dense, offset, weight, confidence):
        return _PooledFeatures.apply(dense, offset, weight, confidence, plan)  # pyright: ignore[reportReturnType]
    return pool_mean(point_features(dense, offset, weight), confidence, plan)


@torch.no_grad()
def pool_point_features_of_chunks(
    chunks: Iterable[Tensor], offset: Tensor, weight: Tensor, confidence: Tensor, plan: VoxelPlan
) -> Tensor:
    """:func:`pool_point_features` of dense features that come in consecutive chunks of rows ``[n, C]``, no gradient."""
    begin = 0

    def features(dense: Tensor) -> Tensor:  # no generator: it would keep a chunk while the next one is made
        nonlocal begin
        begin += len(dense)
        return point_features(dense, offset[begin - len(dense) : begin], weight)

    return pool_mean_of_chunks(map(features, chunks), confidence, plan)


def point_features(dense: Tensor, offset: Tensor, weight: Tensor) -> Tensor:
    """``gelu(dense + offset W^T)``, ``[N, C]``, in float32 whatever the autocast."""
    with torch.autocast(dense.device.type, enabled=False):
        return F.gelu(torch.addmm(dense.float(), offset, weight.t()))


class _PooledFeatures(torch.autograd.Function):
    """The compiled pass; the features are made again for the gradient instead of being kept."""

    @staticmethod
    def forward(ctx: Any, dense: Tensor, offset: Tensor, weight: Tensor, confidence: Tensor, plan: VoxelPlan) -> Tensor:
        """``[M, C]`` means."""
        inputs = [tensor.detach().contiguous() for tensor in (dense, offset, weight.t(), confidence)]
        order, ends = plan.order, plan.starts + plan.counts
        mean, total = dense.new_empty(len(plan), dense.shape[1]), dense.new_empty(len(plan))
        arrays = [tensor.numpy() for tensor in (*inputs, order, plan.starts, ends, mean, total)]
        over_voxels(len(plan), lambda first, last: _pool(*arrays, first, last))
        ctx.save_for_backward(*inputs, mean, total)
        ctx.plan = plan
        return mean

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore
        """Gradients of the dense features, places, weight and confidence."""
        dense, offset, weight, confidence, mean, total = ctx.saved_tensors
        plan: VoxelPlan = ctx.plan
        grad = grad_outputs[0].contiguous()
        along_mean = (grad * mean).sum(-1)
        gradients = [torch.empty_like(dense), torch.empty_like(offset), torch.empty_like(confidence)]
        if len(plan.order) < len(dense):
            left_out = (plan.voxel_of < 0).nonzero().squeeze(1)
            for gradient in gradients:
                gradient.index_fill_(0, left_out, 0)
        of_weight = dense.new_zeros(PARTS, *weight.shape)
        inputs = (dense, offset, weight, confidence, plan.order, plan.starts, plan.starts + plan.counts, total)
        arrays = [tensor.numpy() for tensor in (*inputs, grad, along_mean, *gradients, of_weight)]
        parallel_for(_parts(len(plan)), lambda part: _pool_backward(*arrays, *part))
        of_dense, of_offset, of_confidence = gradients
        return of_dense, of_offset, of_weight.sum(0).t(), of_confidence, None


def _parts(voxels: int) -> list[tuple[int, int, int]]:
    """Number, first voxel and end of every part."""
    bounds = [voxels * part // PARTS for part in range(PARTS + 1)]
    return list(zip(range(PARTS), bounds[:-1], bounds[1:], strict=True))


@kernel(fastmath={"contract", "nsz", "arcp"}, error_model="numpy", nogil=True)
def _pool(dense, offset, weight, confidence, order, starts, ends, mean, total, first, last):
    """Means of voxels ``first`` to ``last`` and the sums of their points' confidences; ``weight`` is ``[3, C]``."""
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
    """Gradients at the points of voxels ``first`` to ``last``, and that of the weight, summed over them."""
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
