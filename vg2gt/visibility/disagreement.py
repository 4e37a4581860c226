"""How far apart the views' depths are, in pixels: how fine the voxels may be."""

from __future__ import annotations

import torch
from torch import Tensor

from vg2gt.geometry.cameras import compose, crop_intrinsics, invert_rigid, transform_points, unproject
from vg2gt.types import Cameras
from vg2gt.visibility.counts import NEAREST

STRIDE = 4  # pixels between those that are looked at, along each axis
NEIGHBORS = 8  # partners of a view that are looked at


@torch.no_grad()
def disagreement(depth: Tensor, cameras: Cameras, partners: Tensor) -> Tensor:
    """Median relative difference between a point's depth in another view and that view's own, times the focal length.

    Args:
        depth: ``[V, H, W]`` of one scene, 0 = none.
        cameras: of the views (B = 1).
        partners: ``[V, K]`` views that each view is compared with, nearest first; -1 = none.

    Returns:
        A scalar in pixels; 0 where no two views see the same.
    """
    height, width = depth.shape[1:]
    pose, intrinsics = cameras.world_to_camera[0].to(depth), cameras.intrinsics[0].to(depth)
    sampled = depth[:, STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
    shifted = crop_intrinsics(intrinsics, STRIDE // 2, STRIDE // 2)
    strided = torch.cat((shifted[:, :2] / STRIDE, shifted[:, 2:]), 1)
    to_world = invert_rigid(pose)
    local = Cameras(torch.eye(4).to(depth).repeat(1, len(depth), 1, 1), strided[None], tuple(sampled.shape[1:]))
    points = unproject(sampled[None], local)[0].flatten(1, 2)  # [V, P, 3] in each view's own frame
    ratios = []
    for other in partners[:, :NEIGHBORS].T:
        there = other.clamp(min=0)
        seen = transform_points(compose(pose[there], to_world)[None], points[None])[0]
        z = seen[..., 2]
        focal, center = intrinsics[there][:, [0, 1], [0, 1]], intrinsics[there][:, :2, 2]
        pixel = seen[..., :2] / z[..., None].clamp(min=NEAREST) * focal[:, None] + center[:, None]
        column, row = pixel.round().unbind(-1)
        inside = (z > NEAREST) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        index = row.clamp(0, height - 1).nan_to_num().long() * width + column.clamp(0, width - 1).nan_to_num().long()
        found = depth[there].flatten(1).gather(1, index)
        known = inside & (found > 0) & (sampled > 0).flatten(1) & (other >= 0)[:, None]
        ratios.append((z / found.clamp(min=NEAREST) - 1).abs()[known])
    every = torch.cat(ratios) if ratios else depth.new_zeros(0)
    return every.median() * intrinsics[:, [0, 1], [0, 1]].mean() if len(every) else depth.new_zeros(())
