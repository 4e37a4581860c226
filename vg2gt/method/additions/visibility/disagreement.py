"""How far apart the views' depths are, in pixels: how fine the voxels may be."""

from __future__ import annotations

import torch
from torch import Tensor

from vg2gt.geometry.cameras import compose, crop_intrinsics, invert_rigid, unproject
from vg2gt.method.additions.visibility.counts import depth_ratio
from vg2gt.types import Cameras

STRIDE = 4  # pixels between those that are looked at, along each axis
NEIGHBORS = 8  # partners of a view that are looked at


@torch.no_grad()
def disagreement(depth: Tensor, cameras: Cameras, partners: Tensor) -> Tensor:
    """Median relative difference of a point's depth in another view and that view's own, in pixels (times the focal).

    Of one scene's ``depth [V, H, W]`` (0 = none) and ``partners [V, K]``, nearest first (-1 = none); 0 where no two
    views see the same.
    """
    pose, intrinsics = cameras.world_to_camera[0].to(depth), cameras.intrinsics[0].to(depth)
    sampled = depth[:, STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
    shifted = crop_intrinsics(intrinsics, STRIDE // 2, STRIDE // 2)
    strided = torch.cat((shifted[:, :2] / STRIDE, shifted[:, 2:]), 1)
    to_world = invert_rigid(pose)
    size = (sampled.shape[1], sampled.shape[2])
    local = Cameras(torch.eye(4).to(depth).repeat(1, len(depth), 1, 1), strided[None], size)
    points = unproject(sampled[None], local)[0].flatten(1, 2)  # [V, P, 3] in each view's own frame
    ratios = []
    for other in partners[:, :NEIGHBORS].T:
        there = other.clamp(min=0)
        ratio, known = depth_ratio(points, depth[there], compose(pose[there], to_world), intrinsics[there])
        known &= (sampled > 0).flatten(1) & (other >= 0)[:, None]
        ratios.append((ratio - 1).abs()[known])
    every = torch.cat(ratios) if ratios else depth.new_zeros(0)
    return every.median() * intrinsics[:, [0, 1], [0, 1]].mean() if len(every) else depth.new_zeros(())
