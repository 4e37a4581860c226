"""The backbone's coloured points as Gaussians, without training (paper, Baselines, "coloured point clouds")."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor

from backends.base import Backend
from vg2gt.baselines.pixels import PixelReconstructor, Pixels, ReadViews
from vg2gt.geometry.spherical_harmonics import rgb_to_sh
from vg2gt.method.additions.visibility import ViewCheck
from vg2gt.method.knn import nearest_neighbors
from vg2gt.model import Background, SceneScale
from vg2gt.types import Gaussians

Spacing = Literal["pixel", "neighbors"]
NEIGHBORS = 3


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
        if spacing not in get_args(Spacing):
            raise ValueError(f"model.spacing is {spacing!r}; choose one of {', '.join(get_args(Spacing))}")
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
    parts = []
    for points in means.split(torch.bincount(pixels.batch).tolist()):
        index = nearest_neighbors(points, points, NEIGHBORS + 1)[:, 1:]  # the nearest is the point itself
        parts.append((points[index] - points[:, None]).square().sum(-1).mean(1).sqrt())
    return torch.maximum(torch.cat(parts), 0.01 * pixels.footprint.mean(-1)) if parts else means[:, 0]
