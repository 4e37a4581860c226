"""Gaussians from a dense head on the frozen tokens: one per pixel, as many models do, or merged by voxel (AnySplat)."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from backends.base import Backend
from vg2gt.baselines.pixels import PixelReconstructor, Pixels, ReadViews
from vg2gt.geometry.rotations import matrix_to_quat, multiply_quats
from vg2gt.geometry.spherical_harmonics import MAX_DEGREE, rgb_to_sh
from vg2gt.method import DenseHead
from vg2gt.method.gaussian_head import harmonic_gains
from vg2gt.method.grid import VoxelPlan, in_range, plan_voxels, point_cells, pool_mean, scene_voxel_size
from vg2gt.model import Background, SceneScale
from vg2gt.types import Gaussians, Tokens
from vg2gt.visibility import ViewCheck

MAX_SCALE = 4.0  # footprints
MIN_SCALE = 1e-2  # footprints: renderers need a finite inverse
_INITIAL_SCALE = 0.5  # footprints
_INITIAL_OPACITY = 0.9


class PixelHead(nn.Module):
    """Two-layer MLP from a pixel's feature to one Gaussian.

    Before training, each Gaussian approximately lies on its unprojected pixel, is isotropic with a standard deviation
    of half a pixel, nearly opaque, and has the pixel's colour.

    Args:
        in_channels: width of the pixel features.
        sh_degree: degree L of the spherical harmonics, 0 to 3.
        max_offset: largest sideways shift of the mean, in pixels.
        max_depth_residual: largest relative change of the depth.
        hidden: width of the hidden layer; None takes ``in_channels``.

    Attributes:
        out: last layer; its last output per pixel is a raw confidence for ``VoxelMerged``.
    """

    def __init__(
        self,
        in_channels: int,
        sh_degree: int = 0,
        max_offset: float = 1.0,
        max_depth_residual: float = 0.1,
        hidden: int | None = None,
    ) -> None:
        super().__init__()
        if not 0 <= sh_degree <= MAX_DEGREE:
            raise ValueError(f"gaussians.sh_degree must be 0 to {MAX_DEGREE}, got {sh_degree}")
        self.sh_degree = sh_degree
        self.max_offset = max_offset
        self.max_depth_residual = max_depth_residual
        bands = (sh_degree + 1) ** 2
        self.parts = (2, 1, 3, 4, 1, 3 * bands, 1)
        # Features of an untrained dense head hardly differ between pixels; VG²GT's point network has norms, too.
        self.norm = nn.LayerNorm(in_channels)
        self.hidden = nn.Linear(in_channels, hidden or in_channels)
        self.out = nn.Linear(hidden or in_channels, sum(self.parts))
        nn.init.normal_(self.out.weight, std=0.02)
        nn.init.zeros_(self.out.bias)
        self.scale_bias = math.log(_INITIAL_SCALE / (MAX_SCALE - _INITIAL_SCALE))
        self.opacity_bias = math.log(_INITIAL_OPACITY / (1 - _INITIAL_OPACITY))
        self.sh_gain: Tensor
        self.register_buffer("sh_gain", harmonic_gains(sh_degree), persistent=False)

    def forward(
        self, features: Tensor, pixels: Pixels, min_footprint: Tensor | None = None
    ) -> tuple[Gaussians, Tensor]:
        """Predicts one Gaussian per pixel.

        Args:
            features: ``[N, C]``.
            pixels: the same N pixels.
            min_footprint: ``[N]`` in scene units; scales are relative to it where it is larger than the pixel. None: 0.

        Returns:
            Gaussians in the order of the pixels, and positive confidences ``[N]``, which are close to the depth
            confidences before training.
        """
        raw = self.out(F.gelu(self.hidden(self.norm(features)))).float()
        shift, residual, scale, rotation, opacity, color, trust = raw.split(self.parts, -1)
        depth = pixels.depth * (1 + self.max_depth_residual * torch.tanh(residual[:, 0]))
        sideways = self.max_offset * pixels.footprint * torch.tanh(shift)
        means = pixels.to_world(pixels.rays * depth[:, None] + F.pad(sideways, (0, 1)))
        footprint = pixels.footprint.mean(-1)
        unit = footprint if min_footprint is None else torch.maximum(footprint, min_footprint)
        scales = unit[:, None] * (MAX_SCALE * torch.sigmoid(scale + self.scale_bias)).clamp(min=MIN_SCALE)
        # In camera axes, like the harmonics: a head that sees images cannot know the world axes.
        quats = F.normalize(rotation + rotation.new_tensor([1.0, 0.0, 0.0, 0.0]), dim=-1)
        quats = multiply_quats(matrix_to_quat(pixels.rotation), quats)
        base = F.pad(rgb_to_sh(pixels.colors)[:, None], (0, 0, 0, len(self.sh_gain) - 1))
        change = pixels.turn_to_world(self.sh_gain * color.unflatten(-1, (-1, 3)))
        gaussians = Gaussians(
            means=means,
            quats=quats,
            scales=scales,
            opacities=torch.sigmoid(opacity[:, 0] + self.opacity_bias),
            sh=base + change,
            batch=pixels.batch,
        )
        # softplus(ln(e - 1)) = 1: training starts from the depth confidence.
        return gaussians, pixels.confidence * F.softplus(trust[:, 0] + math.log(math.e - 1)).clamp(min=1e-6)


class PixelAligned(PixelReconstructor):
    """One Gaussian for every pixel with a depth; only the dense head and the Gaussian head are trained.

    See :class:`vg2gt.model.Reconstructor` for the other arguments.

    Args:
        dense_head: makes the dense head from ``token_dims`` and ``patch_size``.
        gaussians: makes the pixel head from ``in_channels``.
    """

    def __init__(
        self,
        backend: Backend,
        scale: SceneScale,
        dense_head: Callable[..., DenseHead],
        gaussians: Callable[..., nn.Module],
        background: Background = "black",
        visibility: ViewCheck | None = None,
    ) -> None:
        super().__init__(backend, scale, background, visibility)
        self.dense_head = dense_head(token_dims=backend.token_dims, patch_size=backend.patch_size)
        self.gaussians = gaussians(in_channels=self.dense_head.out_channels)

    def features(self, tokens: Tokens, images: Tensor) -> Tensor:
        """Runs the dense head."""
        return self.dense_head(tokens, images).permute(0, 2, 3, 1).flatten(0, 2)

    def make_gaussians(self, features: Tensor, pixels: Pixels, views: ReadViews) -> Gaussians:
        """Returns one Gaussian per pixel."""
        return self.gaussians(F.gelu(features), pixels)[0]


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
        min_footprint: float = 3.3,
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
