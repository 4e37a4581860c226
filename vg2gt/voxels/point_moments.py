"""Second moments of the points in every voxel, plain and in one compiled pass (ours).

How the points lie in their cell, how colour changes among them, where the cameras stand that saw them and how large
their pixels are: confidence-weighted means of 19 products. Written as separate operations, those of all points come and
go a few views at a time; the compiled pass keeps none.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from vg2gt.geometry.symmetric import FULL, UPPER
from vg2gt.io.compiled import kernel
from vg2gt.voxels.grid import VoxelPlan, pool_mean_of_chunks
from vg2gt.voxels.passes import compilable, over_voxels

Moments = tuple[Tensor, Tensor, Tensor, Tensor]


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
        values: ``[N, 6]`` places of the points in their cells, in cells, and their colours; N / V points a view, in the
            order of the views.
        depth: ``[N]`` their depths in scene units, > 0 where a voxel uses them.
        confidence: ``[N]`` > 0.
        views: ``[V, 4]`` a view's camera centre in scene units, and the edge in pixels of a voxel at depth 1.
        means: ``[M, 6]`` of the values in every voxel (:func:`vg2gt.voxels.grid.pool_mean`).
        plan: the voxels.
        views_per_chunk: whose products are there at a time where the pass is not compiled; it bounds the memory.

    Returns:
        ``[M, 3, 3]`` covariance of the places; ``[M, 3 (place), 3 (colour)]`` covariance of place and colour;
        ``[M, 3]`` mean camera centre; ``[M]`` mean side of a pixel at the points' depth, in cells.
    """
    if compilable(values, depth, confidence, views, means):
        return moments_compiled(values, depth, confidence, views, means, plan)
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
    """:func:`pool_point_moments` in plain torch: means of products less products of means."""
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


def moments_compiled(
    values: Tensor, depth: Tensor, confidence: Tensor, views: Tensor, means: Tensor, plan: VoxelPlan
) -> Moments:
    """:func:`pool_point_moments` on a CPU: means of products of what differs from the means."""
    inputs = [tensor.detach().contiguous() for tensor in (values, depth, confidence, views, means)]
    voxels = len(plan)
    found = tuple(values.new_empty(voxels, *shape) for shape in ((3, 3), (3, 3), (3,), ()))
    places = (plan.order, plan.starts, plan.starts + plan.counts)
    arrays = [tensor.numpy() for tensor in (*inputs, *places, *found)]
    over_voxels(voxels, lambda first, last: _pool(*arrays, first, last))
    spread, cross, eye, pixel = found
    return spread, cross, eye, pixel


@kernel(fastmath={"contract", "nsz", "arcp"}, error_model="numpy", nogil=True)
def _pool(values, depth, confidence, views, means, order, starts, ends, spread, cross, eye, pixel, first, last):
    """Moments of voxels ``first`` to ``last``; x, y, z are places, r, g, b colours from the means."""
    views_a_point = len(views) / max(len(values), 1)
    for voxel in range(np.uintp(first), np.uintp(last)):
        mean_x, mean_y, mean_z = means[voxel, 0], means[voxel, 1], means[voxel, 2]
        mean_r, mean_g, mean_b = means[voxel, 3], means[voxel, 4], means[voxel, 5]
        total = eye_x = eye_y = eye_z = side = np.float32(0)
        xx = xy = xz = yy = yz = zz = np.float32(0)
        xr = xg = xb = yr = yg = yb = zr = zg = zb = np.float32(0)
        for place in range(np.uintp(starts[voxel]), np.uintp(ends[voxel])):
            point = np.uintp(order[place])
            view = np.uintp((point + 0.5) * views_a_point)  # a division of integers takes longer
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
