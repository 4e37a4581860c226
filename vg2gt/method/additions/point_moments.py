"""Second moments of the points in every voxel (ours).

They describe the shape of the points in their cell, the change of colour among them, their cameras and pixel size.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.kernels.moments import moments_in_one_pass
from vg2gt.kernels.threads import compilable
from vg2gt.method.grid import VoxelPlan, pool_mean_of_chunks

COLUMNS = (18, 3, 1)  # products of position and (position, colour), camera centre, side of a pixel


@torch.no_grad()
def pool_point_moments(
    values: Tensor,
    depth: Tensor,
    confidence: Tensor,
    views: Tensor,
    means: Tensor,
    plan: VoxelPlan,
    views_per_chunk: int,
) -> Tensor:
    """Confidence-weighted second moments in every voxel, without gradient; compiled for float32 on a CPU.

    Args:
        values: ``[N, 6]`` positions of the points in their cells, and colours; N / V points per view, in view order.
        depth: ``[N]`` scene units, > 0 where a voxel uses them.
        confidence: ``[N]`` > 0.
        views: ``[V, 4]`` camera centre in scene units, and edge of a voxel in pixels at depth 1.
        means: ``[M, 6]`` means of ``values`` in every voxel.
        plan: the voxels.
        views_per_chunk: views at a time where it is not compiled; bounds the memory.

    Returns:
        ``[M, 22]`` (:data:`COLUMNS`): covariances ``[3 (position), 6 (position, colour)]``, mean camera centre ``[3]``
        and mean side of a pixel at the points' depth, in cells.
    """
    per_view = len(values) // len(views)
    centers = F.pad(means, (0, 0, 0, 1))  # [M + 1, 6]; the last for points in no voxel

    def products(first: int) -> Tensor:
        rows = slice(first * per_view, (first + views_per_chunk) * per_view)
        apart = values[rows] - centers[plan.voxel_of[rows]]
        both = (apart[:, :3, None] * apart[:, None]).flatten(1)  # [n, 18]
        eye, edge = views[first : first + views_per_chunk].repeat_interleave(per_view, 0).split((3, 1), -1)
        return torch.cat((both, eye, depth[rows, None] / edge), -1)  # [n, 22]

    chunks = (products(first) for first in range(0, len(views), views_per_chunk))
    if compilable(values, depth, confidence, views, means):
        return moments_in_one_pass(values, depth, confidence, views, means, plan.order, plan.starts, plan.counts)
    return pool_mean_of_chunks(chunks, confidence, plan)
