"""Placement of windows: one frame and unit for the cameras and the depth of all views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from vg2gt.geometry.alignment import Similarity, align_cameras
from vg2gt.geometry.cameras import relative_to_first
from vg2gt.reconstruction.windows.capture import Window
from vg2gt.reconstruction.windows.pose_graph import Found
from vg2gt.types import Cameras


@dataclass(frozen=True)
class Placement:
    """Cameras of all views in one frame: that of the given cameras, or the first window's.

    Attributes:
        cameras: ``[1, V]``.
        scales: ``[V]`` float32 factors from the unit of a view's window to that of the cameras.
    """

    cameras: Cameras
    scales: Tensor

    def seen_from(self, reference: Tensor) -> Cameras:
        """Returns the cameras in the frame of a camera with the pose ``[4, 4]``, float32.

        They are computed in float64 first; the reference itself becomes exactly the identity.
        """
        poses = self.cameras.world_to_camera
        reference = reference.to(poses)
        first = torch.cat((reference[None, None], poses), 1).double()
        seen = relative_to_first(replace(self.cameras, world_to_camera=first)).world_to_camera[:, 1:].float()
        same = (poses == reference).all(-1).all(-1)[..., None, None]
        return replace(self.cameras, world_to_camera=torch.where(same, torch.eye(4), seen))


def moves_onto(found: Sequence[Found], given: Cameras) -> Similarity:
    """Returns the similarities ``[n]`` (float64) that align each window's cameras with the given ones."""
    moves = []
    for window in found:
        there = given.select(window.views)
        exact = replace(there, world_to_camera=there.world_to_camera.double())
        moves.append(align_cameras(window.exact(window.views)[0], exact))
    return Similarity(
        *(torch.cat([getattr(move, part) for move in moves]) for part in ("scale", "rotation", "translation"))
    )


def place_found(
    found: Sequence[Found], moves: Similarity, windows: Sequence[Window], size: tuple[int, int]
) -> Placement:
    """Places windows whose backbone predicts cameras.

    Args:
        found: prediction for each window.
        moves: similarity of each window into one frame.
        windows: the windows.
        size: ``(height, width)`` of the images.
    """
    poses, intrinsics, scales = [], [], []
    for number, (each, window) in enumerate(zip(found, windows, strict=True)):
        move = moves.map(lambda tensor, number=number: tensor[number, None])
        moved = move.apply_cameras(each.exact(each.views)[0]).world_to_camera
        poses.append(moved[:, window.inner])
        intrinsics.append(each.intrinsics[:, window.inner])
        scales.append(move.scale.float().expand(window.own.stop - window.own.start))
    return Placement(Cameras(torch.cat(poses, 1), torch.cat(intrinsics, 1), size), torch.cat(scales))
