"""Which pixels' depth the other views support: our addition to the paper.

A view's depth is right where there is something to match, and a guess elsewhere: on bare walls, in the sky, beyond the
range that was searched. Around an object such guesses hang in the air in front of the cameras on the other side. Other
views tell them apart (:mod:`vg2gt.visibility.counts`): they see through a guess, and they see a surface at the same
place where the depth is right.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from vg2gt.types import Cameras, Geometry
from vg2gt.visibility.counts import count_views
from vg2gt.visibility.partners import choose_partners


@dataclass(frozen=True)
class ViewCheck:
    """Decides which pixels' depth enters the scene.

    A pixel is dropped where more views look through its point than agree with it. Pixels that are dropped say nothing
    in the next round. A pixel that no view agrees with and none contradicts stays.

    Args:
        tolerance: relative difference of depth up to which two views agree.
        margin: relative difference from which on a view looks through a point.
        rounds: how often the views are counted.
        partners: most views that each view is compared with, which bounds the time.

    Raises:
        ValueError: naming an option that is out of range.
    """

    tolerance: float = 0.02
    margin: float = 0.04
    rounds: int = 2
    partners: int = 24

    def __post_init__(self) -> None:
        for name, good, expected in (
            ("tolerance", self.tolerance > 0, "positive"),
            ("margin", self.tolerance <= self.margin < 1, "at least the tolerance and below 1"),
            ("rounds", self.rounds >= 1, "at least 1"),
            ("partners", self.partners >= 1, "at least 1"),
        ):
            if not good:
                raise ValueError(f"model.visibility.{name} must be {expected}, got {getattr(self, name)}")

    @torch.no_grad()
    def __call__(self, geometry: Geometry) -> Tensor:
        """Tells which pixels have a depth that the scene is made of.

        Args:
            geometry: depth, confidence and cameras of B scenes.

        Returns:
            ``[B, V, H, W]`` bool; false where there is no depth.
        """
        return torch.stack([self._supported(*_scene(geometry, index)) for index in range(len(geometry.depth))])

    def _supported(self, depth: Tensor, cameras: Cameras) -> Tensor:
        keep = depth > 0
        partners = choose_partners(depth, cameras, self.partners)
        if not partners.shape[1]:
            return keep
        weight = torch.ones_like(depth)
        for _ in range(self.rounds):
            left = torch.where(keep, depth, 0.0)
            counts = count_views(left, cameras, partners, weight, self.tolerance, self.margin)
            keep = keep & (counts.through <= counts.agree)
        return keep


def _scene(geometry: Geometry, index: int) -> tuple[Tensor, Cameras]:
    """Depth ``[V, H, W]`` of one scene, 0 where not finite, and its cameras (B = 1)."""
    depth = geometry.depth[index].float().nan_to_num(0.0, 0.0, 0.0)
    one, cameras = slice(index, index + 1), geometry.cameras
    return depth, Cameras(cameras.world_to_camera[one], cameras.intrinsics[one], cameras.size)
