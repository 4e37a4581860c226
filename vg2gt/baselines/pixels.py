"""The usable pixels of all views as one packed list, and what lies behind them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from vg2gt.geometry.cameras import invert_rigid, ray_directions
from vg2gt.types import Geometry, TensorRecord


@dataclass(frozen=True)
class Pixels(TensorRecord):
    """The N pixels of B scenes that have a depth, packed in the order (scene, view, row, column).

    Attributes:
        rows: ``[N]`` int64 index into all pixels, flattened from ``[B, V, H, W]``.
        batch: ``[N]`` int64 scene index, sorted.
        rays: ``[N, 3]`` camera-frame directions with unit z.
        depth: ``[N]`` z-depth in scene units.
        confidence: ``[N]`` > 0.
        colors: ``[N, 3]`` in [0, 1].
        footprint: ``[N, 2]`` width and height of the pixel at its depth, in scene units.
        rotation: ``[N, 3, 3]`` camera to world.
        center: ``[N, 3]`` camera centre.
    """

    rows: Tensor
    batch: Tensor
    rays: Tensor
    depth: Tensor
    confidence: Tensor
    colors: Tensor
    footprint: Tensor
    rotation: Tensor
    center: Tensor

    def to_world(self, local: Tensor) -> Tensor:
        """Moves camera-frame points ``[N, 3]``, one a pixel, into the world; elementwise, so no autocast rounds it."""
        return (self.rotation * local[:, None, :]).sum(-1) + self.center


def usable_pixels(geometry: Geometry, images: Tensor) -> Pixels:
    """Lists the pixels whose depth and confidence are finite and positive.

    Args:
        geometry: depth, confidence and cameras in scene units.
        images: ``[B, V, 3, H, W]`` in [0, 1].

    Returns:
        The pixels, in float32.
    """
    depth, confidence = geometry.depth.float(), geometry.depth_conf.float()
    usable = torch.isfinite(depth) & (depth > 0) & torch.isfinite(confidence) & (confidence > 0)
    rows = usable.flatten().nonzero()[:, 0]
    views, height, width = depth.shape[1:]
    view = rows // (height * width)
    camera_to_world = invert_rigid(geometry.cameras.world_to_camera.float()).flatten(0, 1)
    intrinsics = geometry.cameras.intrinsics.float()
    focal = intrinsics[..., [0, 1], [0, 1]].flatten(0, 1)
    depth = depth.flatten()[rows]
    return Pixels(
        rows=rows,
        batch=view // views,
        rays=ray_directions(intrinsics, (height, width)).reshape(-1, 3)[rows],
        depth=depth,
        confidence=confidence.flatten()[rows],
        colors=images.float().permute(0, 1, 3, 4, 2).reshape(-1, 3)[rows],
        footprint=depth[:, None] / focal[view],
        rotation=camera_to_world[view, :3, :3],
        center=camera_to_world[view, :3, 3],
    )
