"""Which pixels' depth the other views support, and how fine voxels may be: our addition to the paper.

A view's depth is right where there is something to match, and a guess elsewhere: on bare walls, in the sky, beyond the
range that was searched. Around an object such guesses hang in the air in front of the cameras on the other side. Other
views tell them apart (:mod:`vg2gt.method.additions.visibility.counts`): they see through a guess, and they see a
surface at the same place where the depth is right.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from vg2gt.method.additions.visibility.counts import count_views
from vg2gt.method.additions.visibility.disagreement import disagreement
from vg2gt.method.additions.visibility.partners import choose_partners
from vg2gt.types import Cameras, Geometry, TensorRecord


@dataclass(frozen=True)
class Support(TensorRecord):
    """What views say of each other's depth.

    Attributes:
        keep: ``[B, V, H, W]`` bool, pixels that have a depth the scene is made of.
        coarsen: ``[B]`` factor >= 1 of the smallest voxel.
    """

    keep: Tensor
    coarsen: Tensor


@dataclass(frozen=True)
class ViewCheck:
    """Decides which pixels' depth enters the scene, and how fine its voxels may be.

    A pixel is dropped where more views look through its point than agree with it. Pixels that are dropped say nothing
    in the next round. A pixel that no view agrees with and none contradicts stays.

    Args:
        tolerance: relative difference of depth up to which two views agree.
        margin: relative difference from which on a view looks through a point.
        rounds: how often the views are counted.
        partners: most views that each view is compared with, which bounds the time.
        fine_below: median disagreement of views in pixels up to which voxels are as fine as configured; above, the
            smallest voxel grows in proportion.
        coarsest: largest factor by which it grows.

    Raises:
        ValueError: naming an option that is out of range.
    """

    tolerance: float = 0.02
    margin: float = 0.04
    rounds: int = 2
    partners: int = 24
    fine_below: float = 1.4
    coarsest: float = 2.0

    def __post_init__(self) -> None:
        for name, good, expected in (
            ("tolerance", self.tolerance > 0, "positive"),
            ("margin", self.tolerance <= self.margin < 1, "at least the tolerance and below 1"),
            ("rounds", self.rounds >= 1, "at least 1"),
            ("partners", self.partners >= 1, "at least 1"),
            ("fine_below", self.fine_below > 0, "positive"),
            ("coarsest", self.coarsest >= 1, "at least 1"),
        ):
            if not good:
                raise ValueError(f"model.visibility.{name} must be {expected}, got {getattr(self, name)}")

    @torch.no_grad()
    def __call__(self, geometry: Geometry) -> Support:
        """Checks the depth of B scenes; ``keep`` is false where there is none."""
        scenes = [self._check(*_scene(geometry, index)) for index in range(len(geometry.depth))]
        return Support(*(torch.stack(parts) for parts in zip(*scenes, strict=True)))

    def _check(self, depth: Tensor, cameras: Cameras) -> tuple[Tensor, Tensor]:
        keep = depth > 0
        partners = choose_partners(depth, cameras, self.partners)
        coarsen = (disagreement(depth, cameras, partners) / self.fine_below).clamp(1, self.coarsest)
        for _ in range(self.rounds):
            left = torch.where(keep, depth, 0.0)
            counts = count_views(left, cameras, partners, self.tolerance, self.margin)
            keep = keep & (counts.through <= counts.agree)
        return keep, coarsen


def _scene(geometry: Geometry, index: int) -> tuple[Tensor, Cameras]:
    """Depth ``[V, H, W]`` of one scene, 0 where not finite, and its cameras (B = 1)."""
    depth = geometry.depth[index].float().nan_to_num(0.0, 0.0, 0.0)
    one, cameras = slice(index, index + 1), geometry.cameras
    return depth, Cameras(cameras.world_to_camera[one], cameras.intrinsics[one], cameras.size)
