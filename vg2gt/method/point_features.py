"""Pools pixel features into voxels: ``sum n gelu(f + W o) / sum n``, in plain torch and in one compiled pass.

f is a pixel's dense feature, o its position within the cell and n its confidence (paper, eqn voxelfeature). Separate
operations allocate four arrays of all pixels' features; the compiled pass allocates none.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.kernels.point_features import PooledFeatures
from vg2gt.kernels.threads import compilable
from vg2gt.method.grid import VoxelPlan, pool_mean, pool_mean_of_chunks


def pool_point_features(dense: Tensor, offset: Tensor, weight: Tensor, confidence: Tensor, plan: VoxelPlan) -> Tensor:
    """Returns the confidence-weighted mean of the points' features in every voxel.

    Args:
        dense: ``[N, C]`` dense features of the pixels.
        offset: ``[N, 3]`` positions within their cells, in [-1/2, 1/2].
        weight: ``[C, 3]`` linear layer from position to feature.
        confidence: ``[N]`` > 0.
        plan: the voxels.

    Returns:
        ``[M, C]``, differentiable in all tensors. Compiled if they are float32 on a CPU.
    """
    if len(plan) and compilable(dense, offset, weight, confidence):
        places = (plan.order, plan.starts, plan.counts, plan.voxel_of)
        return PooledFeatures.apply(dense, offset, weight, confidence, *places)  # pyright: ignore[reportReturnType]
    return pool_mean(point_features(dense, offset, weight), confidence, plan)


@torch.no_grad()
def pool_point_features_of_chunks(
    chunks: Iterable[Tensor], offset: Tensor, weight: Tensor, confidence: Tensor, plan: VoxelPlan
) -> Tensor:
    """Computes :func:`pool_point_features` without gradient from consecutive chunks ``[n, C]`` of dense features."""
    begin = 0

    def features(dense: Tensor) -> Tensor:  # not a generator, which would hold a chunk while the next is computed
        nonlocal begin
        begin += len(dense)
        return point_features(dense, offset[begin - len(dense) : begin], weight)

    return pool_mean_of_chunks(map(features, chunks), confidence, plan)


def point_features(dense: Tensor, offset: Tensor, weight: Tensor) -> Tensor:
    """Returns ``gelu(dense + offset W^T)``, ``[N, C]``, in float32 under any autocast."""
    with torch.autocast(dense.device.type, enabled=False):
        return F.gelu(torch.addmm(dense.float(), offset, weight.t()))
