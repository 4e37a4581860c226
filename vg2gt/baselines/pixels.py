"""Usable pixels of all views as one packed list, and a base class for models with per-pixel Gaussians."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from vg2gt.geometry.cameras import invert_rigid, ray_directions
from vg2gt.geometry.spherical_harmonics import rotation_of_coefficients
from vg2gt.model import Reconstructor
from vg2gt.profiling import stage
from vg2gt.types import Gaussians, Geometry, Hints, Prediction, TensorRecord, Tokens

ReadViews = tuple[Tokens, Geometry, Tensor]
SMALLEST_FOOTPRINT = 1e-7  # scene units; a hundredth of it is still a valid scale for the renderer


@dataclass(frozen=True)
class Pixels(TensorRecord):
    """The N pixels of B scenes that have a depth, packed in the order (scene, view, row, column).

    Attributes:
        rows: ``[N]`` int64 index into all pixels, flattened from ``[B, V, H, W]``.
        view: ``[N]`` int64 index into the ``B * V`` views, sorted.
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
    view: Tensor
    batch: Tensor
    rays: Tensor
    depth: Tensor
    confidence: Tensor
    colors: Tensor
    footprint: Tensor
    rotation: Tensor
    center: Tensor

    def to_world(self, local: Tensor) -> Tensor:
        """Transforms camera-frame points ``[N, 3]``, one per pixel, to the world; elementwise to avoid autocast."""
        return (self.rotation * local[:, None, :]).sum(-1) + self.center

    def turn_to_world(self, sh: Tensor) -> Tensor:
        """Rotates SH coefficients ``[N, (L + 1)^2, 3]`` from camera axes to world axes."""
        degree = math.isqrt(sh.shape[1]) - 1
        if degree == 0:
            return sh
        counts = torch.bincount(self.view)
        last = counts.cumsum(0) - 1  # a view without pixels gets a neighbour's rotation, for no rows
        turns = rotation_of_coefficients(self.rotation[last.clamp(min=0)], degree)
        parts = sh.split(counts.tolist())
        return torch.cat([turn @ part for turn, part in zip(turns, parts, strict=True)]) if parts else sh


def usable_pixels(geometry: Geometry, images: Tensor) -> Pixels:
    """Packs the pixels whose depth and confidence are finite and positive; geometry is in scene units."""
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
        view=view,
        batch=view // views,
        rays=ray_directions(intrinsics, (height, width)).reshape(-1, 3)[rows],
        depth=depth,
        confidence=confidence.flatten()[rows],
        colors=images.float().permute(0, 1, 3, 4, 2).reshape(-1, 3)[rows],
        footprint=(depth[:, None] / focal[view]).clamp(min=SMALLEST_FOOTPRINT),
        rotation=camera_to_world[view, :3, :3],
        center=camera_to_world[view, :3, 3],
    )


def harmonic_gains(degree: int) -> Tensor:
    """Returns factors ``[(degree + 1)^2, 1]`` that make predicted SH coefficients of higher degrees start small."""
    degrees = [each for each in range(degree + 1) for _ in range(2 * each + 1)]
    return torch.tensor([0.1 * 0.25**each if each else 1.0 for each in degrees])[:, None]


class PixelReconstructor(Reconstructor):
    """Base class of models that make Gaussians of pixels; geometry is the backbone's own.

    See :class:`vg2gt.model.Reconstructor` for the arguments.
    """

    def forward(
        self, images: Tensor, hints: Hints | None = None, generator: torch.Generator | None = None
    ) -> Prediction:
        """Reconstructs B scenes; see :meth:`vg2gt.model.Reconstructor.forward`. Deterministic."""
        views = tokens, geometry, unit = self.read_views(images, hints)
        support = self.support(geometry, hints)
        keep = None if support is None else support.keep
        with stage("fine"):
            features = self.features(tokens, images)
        with stage("gaussians"), torch.autocast(images.device.type, enabled=False):
            pixels = usable_pixels(geometry.where(keep), images)
            gaussians = self.make_gaussians(features.index_select(0, pixels.rows).float(), pixels, views)
        gaussians = self.with_background(gaussians, images, geometry.depth)
        return Prediction(geometry, geometry, unit, None, gaussians, keep)

    def features(self, tokens: Tokens, images: Tensor) -> Tensor:
        """Returns features of all pixels ``[B * V * H * W, C]``, by default of width 0."""
        return images.new_zeros(images[:, :, 0].numel(), 0)

    @abstractmethod
    def make_gaussians(self, features: Tensor, pixels: Pixels, views: ReadViews) -> Gaussians:
        """Returns the Gaussians of B scenes.

        Args:
            features: features of the usable pixels ``[N, C]``.
            pixels: the same N pixels.
            views: result of :meth:`vg2gt.model.Reconstructor.read_views`.
        """
