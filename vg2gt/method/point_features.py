"""Features of pixels pooled into voxels: ``sum n gelu(f + W o) / sum n``, plain and in one compiled pass.

f is a pixel's dense feature, o its place within the cell and n its confidence (paper, eqn voxelfeature). As separate
operations, four arrays of all pixels' features come and go; the compiled pass keeps none.
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
        places = (plan.order, plan.starts, plan.counts, plan.voxel_of)
        return PooledFeatures.apply(dense, offset, weight, confidence, *places)  # pyright: ignore[reportReturnType]
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
