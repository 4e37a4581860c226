"""Pixel Gaussians merged by voxels with confidence weights, as AnySplat does."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from backends.base import Backend
from vg2gt.baselines.pixel_aligned import PixelAligned
from vg2gt.baselines.pixels import Pixels, ReadViews
from vg2gt.method import DenseHead
from vg2gt.method.additions.visibility import ViewCheck
from vg2gt.method.grid import VoxelPlan, in_range, plan_voxels, point_cells, pool_mean, scene_voxel_size
from vg2gt.model import Background, SceneScale
from vg2gt.types import Gaussians


class VoxelMerged(PixelAligned):
    """Predicts one Gaussian per pixel, then merges all Gaussians of a voxel into their confidence-weighted mean.

    Merges decoded parameters, not features: no network sees a voxel as a whole, and each voxel holds one Gaussian.
    Scales are relative to the voxel where it is larger than the pixel, so that merged Gaussians leave no holes before
    training. See :class:`PixelAligned` for the other arguments.

    Args:
        voxel_size: edge length in scene units.
        min_footprint: smallest edge in pixels at the scene's median depth; 0: no limit.
    """

    def __init__(
        self,
        backend: Backend,
        scale: SceneScale,
        dense_head: Callable[..., DenseHead],
        gaussians: Callable[..., nn.Module],
        voxel_size: float = 0.002,
        min_footprint: float = 1.0,
        background: Background = "black",
        visibility: ViewCheck | None = None,
    ) -> None:
        super().__init__(backend, scale, dense_head, gaussians, background, visibility)
        self.voxel_size = voxel_size
        self.min_footprint = min_footprint

    def make_gaussians(self, features: Tensor, pixels: Pixels, views: ReadViews) -> Gaussians:
        """Returns one Gaussian per occupied voxel."""
        size = scene_voxel_size(views[1], self.voxel_size, self.min_footprint)
        single, confidence = self.gaussians(F.gelu(features), pixels, min_footprint=size[pixels.batch])
        return merge_by_voxel(single, confidence, size)


def merge_by_voxel(gaussians: Gaussians, confidence: Tensor, voxel_size: Tensor) -> Gaussians:
    """Replaces the Gaussians of every voxel by their mean, weighted by ``confidence`` ``[N]`` > 0.

    Voxels have edge ``voxel_size`` ``[B]`` in scene units; Gaussians outside the range of cell indices are dropped.
    Differentiable in parameters and confidence, but not in the assignment to voxels.
    """
    cells = point_cells(gaussians.means, gaussians.batch, voxel_size)
    plan = plan_voxels(cells, gaussians.batch, in_range(cells.detach()))
    offset = (cells - cells.detach().floor() - 0.5).float()
    quats = _same_signs(gaussians.quats, confidence, plan)
    parts = (offset, quats, gaussians.scales, gaussians.opacities[:, None], gaussians.sh.flatten(1))
    merged = pool_mean(torch.cat(parts, -1), confidence, plan)
    offset, quats, scales, opacities, sh = merged.split([part.shape[1] for part in parts], -1)
    # Not grid * size + ...: centre plus offset keeps the mean inside its cell in float32.
    means = (plan.grid + 0.5 + offset.double()) * voxel_size.double()[plan.batch, None]
    return Gaussians(
        means=means.to(merged.dtype),
        quats=F.normalize(quats, dim=-1),
        scales=scales,
        opacities=opacities[:, 0],
        sh=sh.unflatten(-1, gaussians.sh.shape[1:]),
        batch=plan.batch,
    )


def _same_signs(quats: Tensor, confidence: Tensor, plan: VoxelPlan) -> Tensor:
    """Aligns the signs of quaternions ``[N, 4]`` by their voxel's largest component, so that they do not cancel."""
    decisive = pool_mean(quats.detach().square(), confidence.detach(), plan).argmax(-1)
    own = quats.detach().gather(1, decisive[plan.voxel_of.clamp(min=0), None]) if len(plan) else quats[:, :1]
    return torch.where(own < 0, -quats, quats)
