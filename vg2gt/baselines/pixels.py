"""Usable pixels of all views as one packed list, a base class for models with per-pixel Gaussians, and the simplest."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from backends.base import Backend
from vg2gt.geometry.cameras import invert_rigid, ray_directions
from vg2gt.geometry.spherical_harmonics import rgb_to_sh, rotation_of_coefficients
from vg2gt.kernels.knn import nearest_in_scenes
from vg2gt.model import Background, Reconstructor, SceneScale, background_sums
from vg2gt.profiling import stage
from vg2gt.types import Gaussians, Geometry, Hints, Prediction, TensorRecord, Tokens, check_choice
from vg2gt.visibility import ViewCheck

ReadViews = tuple[Tokens, Geometry, Tensor]
SMALLEST_FOOTPRINT = 1e-7  # scene units; a hundredth of it is still a valid scale for the renderer
Spacing = Literal["pixel", "neighbors"]
NEIGHBORS = 3


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
        gaussians = self.with_background(gaussians, background_sums(images, geometry.depth))
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


class PointCloud(PixelReconstructor):
    """One isotropic Gaussian per pixel, as wide as the spacing of the points.

    See :class:`vg2gt.model.Reconstructor` for the other arguments.

    Args:
        spacing: ``pixel``: size of the pixel at its depth. ``neighbors``: root mean square distance to the three
            nearest points; with ``opacity=0.1`` this is the 3DGS initialisation from a point cloud.
        width: standard deviation relative to the spacing.
        opacity: opacity of every Gaussian, in (0, 1).

    Raises:
        ValueError: if the spacing is unknown.
    """

    def __init__(
        self,
        backend: Backend,
        scale: SceneScale,
        spacing: Spacing = "pixel",
        width: float = 0.5,
        opacity: float = 0.9,
        background: Background = "black",
        visibility: ViewCheck | None = None,
    ) -> None:
        check_choice("model.spacing", spacing, Spacing)
        super().__init__(backend, scale, background, visibility)
        self.spacing = spacing
        self.width = width
        self.opacity = opacity

    def make_gaussians(self, features: Tensor, pixels: Pixels, views: ReadViews) -> Gaussians:
        """Returns one Gaussian per pixel; uses no features."""
        means = pixels.to_world(pixels.rays * pixels.depth[:, None])
        spacing = pixels.footprint.mean(-1) if self.spacing == "pixel" else _distance_to_neighbors(means, pixels)
        return Gaussians(
            means=means,
            quats=means.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(means), 1),
            scales=(self.width * spacing)[:, None].repeat(1, 3),
            opacities=torch.full_like(spacing, self.opacity),
            sh=rgb_to_sh(pixels.colors)[:, None],
            batch=pixels.batch,
        )


def _distance_to_neighbors(means: Tensor, pixels: Pixels) -> Tensor:
    """Returns each point's RMS distance ``[N]`` to its nearest neighbours in the scene, at least 1 % of a pixel."""
    if not len(means):
        return means[:, 0]
    scenes = int(pixels.batch[-1]) + 1
    index, found = nearest_in_scenes(means, pixels.batch, means, pixels.batch, NEIGHBORS + 1, scenes)
    squared = (means[index] - means[:, None]).square().sum(-1) * found  # [N, 4], the nearest is the point itself
    distance = (squared.sum(1) / (found.sum(1) - 1).clamp(min=1)).sqrt()
    return torch.maximum(distance, 0.01 * pixels.footprint.mean(-1))
