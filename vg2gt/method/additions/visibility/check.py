"""Which pixels' depth the other views support, and how fine voxels may be: our addition to the paper.

Depth is a guess on bare walls, in the sky and beyond the searched range; in voxels such guesses hang in the air. Other
views see through a guess, and see a surface at the same place where the depth is right.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from vg2gt.method.additions.visibility.counts import count_views
from vg2gt.method.additions.visibility.disagreement import disagreement
from vg2gt.method.additions.visibility.moved import LEAST, moved
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

    A pixel is dropped where more views look through its point than agree with it, and says nothing in the next round.

    Args:
        tolerance: relative difference of depth up to which two views agree.
        margin: relative difference from which on a view looks through a point.
        rounds: how often the views are counted.
        partners: most views that each view is compared with, which bounds the time.
        fine_below: median disagreement of views in pixels up to which voxels are as fine as configured; above, the
            smallest voxel grows in proportion.
        coarsest: largest factor by which it grows.
        moment: frames of a moment. What is gone at another moment moves, and is dropped wherever it is seen
            (:mod:`vg2gt.method.additions.visibility.moved`); None takes everything for static.
        moved_margin: relative difference from which on a view tells that something is gone.

    Raises:
        ValueError: naming an option that is out of range.
    """

    tolerance: float = 0.02
    margin: float = 0.04
    rounds: int = 2
    partners: int = 24
    fine_below: float = 1.4
    coarsest: float = 2.0
    moment: int | None = None
    moved_margin: float = 0.08

    def __post_init__(self) -> None:
        for name, good, expected in (
            ("tolerance", self.tolerance > 0, "positive"),
            ("margin", self.tolerance <= self.margin < 1, "at least the tolerance and below 1"),
            ("rounds", self.rounds >= 1, "at least 1"),
            ("partners", self.partners >= 1, "at least 1"),
            ("fine_below", self.fine_below > 0, "positive"),
            ("coarsest", self.coarsest >= 1, "at least 1"),
            ("moment", self.moment is None or self.moment >= LEAST, f"at least {LEAST}, or null"),
            ("moved_margin", self.tolerance <= self.moved_margin < 1, "at least the tolerance and below 1"),
        ):
            if not good:
                raise ValueError(f"model.visibility.{name} must be {expected}, got {getattr(self, name)}")

    @torch.no_grad()
    def __call__(self, geometry: Geometry, frames: Tensor | None = None) -> Support:
        """Checks the depth of B scenes; ``keep`` is false where there is none.

        Args:
            geometry: of B scenes.
            frames: ``[B, V]`` numbers of the frames in the order of time; None: nothing is known of time, so nothing is
                taken to move.
        """
        times = [None] * len(geometry.depth) if frames is None else frames.to(geometry.depth.device)
        scenes = [self._check(*_scene(geometry, index), time) for index, time in enumerate(times)]
        return Support(*(torch.stack(parts) for parts in zip(*scenes, strict=True)))

    def _check(self, depth: Tensor, cameras: Cameras, frames: Tensor | None) -> tuple[Tensor, Tensor]:
        keep = depth > 0
        partners = choose_partners(depth, cameras, self.partners)
        coarsen = (disagreement(depth, cameras, partners) / self.fine_below).clamp(1, self.coarsest)
        for _ in range(self.rounds):
            left = torch.where(keep, depth, 0.0)
            counts = count_views(left, cameras, partners, self.tolerance, self.margin)
            keep = keep & (counts.through <= counts.agree)
        if self.moment is not None and frames is not None:
            left = torch.where(keep, depth, 0.0)
            keep = keep & ~moved(left, cameras, partners, frames, self.moment, self.tolerance, self.moved_margin)
        return keep, coarsen


def _scene(geometry: Geometry, index: int) -> tuple[Tensor, Cameras]:
    """Depth ``[V, H, W]`` of one scene, 0 where not finite, and its cameras (B = 1)."""
    depth = geometry.depth[index].float().nan_to_num(0.0, 0.0, 0.0)
    one, cameras = slice(index, index + 1), geometry.cameras
    return depth, Cameras(cameras.world_to_camera[one], cameras.intrinsics[one], cameras.size)
