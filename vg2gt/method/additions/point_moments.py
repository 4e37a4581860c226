"""Second moments of the points in every voxel, in plain torch and in one compiled pass (ours).

They describe the shape of the points in their cell, the change of colour among them, their cameras and pixel size.
"""

from __future__ import annotations

import torch
from torch import Tensor

from vg2gt.geometry.symmetric import FULL, UPPER
from vg2gt.kernels.point_moments import Moments, moments_compiled
from vg2gt.kernels.threads import compilable
from vg2gt.method.grid import VoxelPlan, pool_mean_of_chunks


@torch.no_grad()
def pool_point_moments(
    values: Tensor,
    depth: Tensor,
    confidence: Tensor,
    views: Tensor,
    means: Tensor,
    plan: VoxelPlan,
    views_per_chunk: int,
) -> Moments:
    """Confidence-weighted second moments in every voxel, without gradient; compiled for float32 on a CPU.

    Args:
        values: ``[N, 6]`` positions of the points in their cells, and colours; N / V points per view, in view order.
        depth: ``[N]`` scene units, > 0 where a voxel uses them.
        confidence: ``[N]`` > 0.
        views: ``[V, 4]`` camera centre in scene units, and edge of a voxel in pixels at depth 1.
        means: ``[M, 6]`` means of ``values`` in every voxel.
        plan: the voxels.
        views_per_chunk: views at a time if the pass is not compiled; bounds the memory.

    Returns:
        Covariances ``[M, 3, 3]`` of position and ``[M, 3 (position), 3 (colour)]`` of position and colour, mean camera
        centre ``[M, 3]``, and mean side ``[M]`` of a pixel at the points' depth, in cells.
    """
    if compilable(values, depth, confidence, views, means):
        return moments_compiled(values, depth, confidence, views, means, plan.order, plan.starts, plan.counts)
    return moments_reference(values, depth, confidence, views, means, plan, views_per_chunk)


def moments_reference(
    values: Tensor,
    depth: Tensor,
    confidence: Tensor,
    views: Tensor,
    means: Tensor,
    plan: VoxelPlan,
    views_per_chunk: int,
) -> Moments:
    """:func:`pool_point_moments` in plain torch: means of products minus products of means."""
    per_view = len(values) // len(views)
    upper = torch.tensor(UPPER, device=values.device)

    def products(first: int) -> Tensor:
        rows = slice(first * per_view, (first + views_per_chunk) * per_view)
        place, color = values[rows].split(3, -1)
        squares = place.index_select(1, upper[0]) * place.index_select(1, upper[1])  # [n, 6]
        mixed = (place[:, :, None] * color[:, None]).flatten(1)  # [n, 9]
        eye, edge = views[first : first + views_per_chunk].repeat_interleave(per_view, 0).split((3, 1), -1)
        return torch.cat((squares, mixed, eye, depth[rows, None] / edge), -1)  # [n, 19]

    chunks = (products(first) for first in range(0, len(views), views_per_chunk))
    squares, mixed, eye, pixel = pool_mean_of_chunks(chunks, confidence, plan).split((6, 9, 3, 1), -1)
    place, color = means.split(3, -1)
    spread = squares - place[:, UPPER[0]] * place[:, UPPER[1]]
    cross = mixed.unflatten(-1, (3, 3)) - place[:, :, None] * color[:, None]
    return spread[:, FULL].unflatten(-1, (3, 3)), cross, eye, pixel[:, 0]
