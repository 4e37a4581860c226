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
from vg2gt.visibility.counts import ViewCounts, count_views
from vg2gt.visibility.partners import choose_partners


@dataclass(frozen=True)
class ViewCheck:
    """Decides which pixels' depth enters the scene.

    A pixel is dropped where more views look through its point than agree with it. Pixels that are dropped say nothing
    in the next round. A pixel that no view agrees with and none contradicts stays if it is confident: what a single
    view sees is kept, its guesses are not.

    Args:
        tolerance: relative difference of depth up to which two views agree.
        margin: relative difference from which on a view looks through a point.
        rounds: how often the views are counted.
        doubtful: smallest confidence of a pixel that no other view agrees with, as a share of the median confidence of
            those that some view agrees with; 0 keeps them all.
        partners: most views that each view is compared with, which bounds the time.

    Raises:
        ValueError: naming an option that is out of range.
    """

    tolerance: float = 0.02
    margin: float = 0.04
    rounds: int = 2
    doubtful: float = 0.25
    partners: int = 24

    def __post_init__(self) -> None:
        for name, good, expected in (
            ("tolerance", self.tolerance > 0, "positive"),
            ("margin", self.tolerance <= self.margin < 1, "at least the tolerance and below 1"),
            ("rounds", self.rounds >= 1, "at least 1"),
            ("doubtful", self.doubtful >= 0, "at least 0"),
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

    def counts(self, depth: Tensor, cameras: Cameras, partners: Tensor) -> ViewCounts:
        """What the ``partners [V, K]`` say of each pixel of one scene; arguments as of :func:`count_views`."""
        return count_views(depth, cameras, partners, torch.ones_like(depth), self.tolerance, self.margin)

    def _supported(self, depth: Tensor, confidence: Tensor, cameras: Cameras) -> Tensor:
        keep = depth > 0
        partners = choose_partners(depth, cameras, self.partners)
        if not partners.shape[1]:
            return keep
        counts = self.counts(depth, cameras, partners)
        keep = keep & (counts.through <= counts.agree)
        for _ in range(self.rounds - 1):
            counts = self.counts(torch.where(keep, depth, 0.0), cameras, partners)
            keep = keep & (counts.through <= counts.agree)
        agreed = keep & (counts.agree > 0)
        if self.doubtful and agreed.any():
            keep = agreed | (keep & (confidence >= self.doubtful * confidence[agreed].median()))
        return keep


def _scene(geometry: Geometry, index: int) -> tuple[Tensor, Tensor, Cameras]:
    """Depth and confidence ``[V, H, W]`` of one scene, 0 where not finite, and its cameras (B = 1)."""
    maps = (geometry.depth[index].float(), geometry.depth_conf[index].float())
    depth, confidence = (values.nan_to_num(0.0, 0.0, 0.0) for values in maps)
    one, cameras = slice(index, index + 1), geometry.cameras
    return depth, confidence, Cameras(cameras.world_to_camera[one], cameras.intrinsics[one], cameras.size)
