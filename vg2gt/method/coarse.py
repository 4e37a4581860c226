"""Coarse-level feature enhancement of patch tokens with voxels shared by all views (paper, Coarse-level)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from vg2gt.geometry.cameras import strided_intrinsics, unproject
from vg2gt.geometry.precision import full_precision
from vg2gt.kernels.knn import interpolate, interpolation_weights
from vg2gt.method.additions.silhouette import near_silhouettes
from vg2gt.method.additions.surface_evidence import (
    CENTROID_CHANNELS,
    SURFACE_CHANNELS,
    PointFrames,
    cell_centroids,
    disagreement,
    gate,
    vectors_to_surface,
    voxel_evidence,
)
from vg2gt.method.grid import (
    VoxelPlan,
    in_range,
    plan_voxels,
    point_cells,
    pool_mean,
    pool_min,
    scene_voxel_size,
)
from vg2gt.method.ptv3 import PTv3
from vg2gt.types import Cameras, Geometry, Tokens, check_choice

Inject = Literal["last", "all"]


class CoarseModule(nn.Module):
    """Enhances patch tokens with PTv3 over coarse voxels, fused through a zero-initialised projection.

    The points come from the frozen backbone's geometry, without gradient. Patches without a valid point keep their
    tokens. ``surface_evidence=False embedding_skip=False fuse_kernel=1 gate=False`` (``model=vg2gt``) is the paper's
    module.

    Args:
        token_dims: width of each tapped layer, shallow to deep.
        patch_size: pixels per patch side, a multiple of ``upsample``.
        ptv3: factory of the voxel network, called with ``in_channels``.
        voxel_size: edge length in scene units.
        min_footprint: smallest edge in pixels at the scene's median depth; 0 disables this bound.
        hidden: widths of the MLP from tokens to voxel features.
        fuse_channels: width of the fusing convolutions on the patch grid.
        neighbors: number of nearest voxels that are interpolated at a point.
        inject: taps to change: ``all``, or only the ``last``.
        upsample: points per patch along each axis.
        surface_evidence: ours: adds the voxels' centroids to the input of PTv3, and each point's distance from the
            surface that the views agree on to the input of the fusion.
        embedding_skip: ours: adds the patches' own embedding to the input of the fusion.
        fuse_kernel: edge length of the fusing convolutions: 1 (paper), or 3 to include neighbouring patches.
        gate: ours: ignores evidence near silhouettes, and scales all changes by how much the views disagree. Needs
            ``surface_evidence``.

    Raises:
        ValueError: if an option is invalid or conflicts with another; the message names it.
    """

    def __init__(
        self,
        token_dims: Sequence[int],
        patch_size: int,
        ptv3: Callable[..., PTv3],
        voxel_size: float = 0.01,
        min_footprint: float = 0.0,
        hidden: Sequence[int] = (1536, 1024),
        fuse_channels: int = 1024,
        neighbors: int = 16,
        inject: Inject = "all",
        upsample: int = 2,
        surface_evidence: bool = True,
        embedding_skip: bool = True,
        fuse_kernel: int = 3,
        gate: bool = False,
    ) -> None:
        super().__init__()
        check_choice("coarse.inject", inject, Inject)
        if fuse_kernel not in (1, 3):
            raise ValueError(f"coarse.fuse_kernel is {fuse_kernel!r}; choose 1 or 3")
        if gate and not surface_evidence:
            raise ValueError("coarse.gate=true requires coarse.surface_evidence=true")
        if patch_size % upsample:
            raise ValueError(f"coarse.upsample={upsample} must divide the backend's patch size ({patch_size} pixels)")
        self.cell = patch_size // upsample
        self.upsample = upsample
        self.voxel_size = voxel_size
        self.min_footprint = min_footprint
        self.neighbors = neighbors
        self.surface_evidence = surface_evidence
        self.embedding_skip = embedding_skip
        self.gate = gate
        layers: list[nn.Module] = [nn.LayerNorm(token_dims[-1])]
        for width_in, width_out in zip((token_dims[-1], *hidden), hidden, strict=False):
            layers += [nn.Linear(width_in, width_out), nn.GELU()]
        self.embed = nn.Sequential(*layers)
        self.ptv3 = ptv3(in_channels=hidden[-1] + CENTROID_CHANNELS * surface_evidence + 1)
        width = self.ptv3.out_channels + SURFACE_CHANNELS * surface_evidence + hidden[-1] * embedding_skip
        self.fuse = nn.Sequential(
            nn.Conv2d(width, fuse_channels, fuse_kernel, padding=fuse_kernel // 2),
            nn.GELU(),
            nn.Conv2d(fuse_channels, fuse_channels, fuse_kernel, padding=fuse_kernel // 2),
            nn.GELU(),
        )
        self.zero = nn.ModuleList(
            nn.Conv2d(fuse_channels, dim, 1) for dim in (token_dims if inject == "all" else token_dims[-1:])
        )
        for parameter in self.zero.parameters():
            nn.init.zeros_(parameter)

    def forward(self, tokens: Tokens, geometry: Geometry, generator: torch.Generator | None = None) -> Tokens:
        """Enhances tokens.

        Args:
            tokens: the frozen backbone's tokens.
            geometry: geometry decoded from them, in scene units and the frame of context view 0.
            generator: shuffles the serialisation orders while training.

        Returns:
            The tokens with enhanced patches; before training bit-equal to the input. The camera token is unchanged.

        Raises:
            ValueError: if a scene spans too many voxels to index.
        """
        # pixels to packed points of the upsampled patch grid: N points
        with full_precision(geometry.depth):
            size = scene_voxel_size(geometry, self.voxel_size, self.min_footprint)
            points = PatchPoints(geometry, self.cell, size, away_from_silhouettes=self.gate)
        embedded = self._embed(tokens)[points.rows].float()  # f(p): [N, C]
        # points to voxels, PTv3, back to points: [N, C]
        enhanced, gain = self._enhance(embedded, points, generator)
        if self.embedding_skip:
            enhanced = torch.cat((enhanced, embedded), -1)
        # points to patches: [B, V, P, C]
        patches, seen = self._to_patches(enhanced, points, tokens)
        maps = patches.flatten(0, 1).transpose(1, 2).unflatten(-1, tokens.grid)  # [B V, C, rows, columns]
        fused = self.fuse(maps)
        # zero convolution: the update of each tap's tokens, 0 before training
        updates = [gain * _to_patch_rows(branch(fused), seen) for branch in self.zero]  # [B, V, P, D] each
        untouched = tokens.patch[: len(tokens.patch) - len(updates)]
        changed = tokens.patch[len(untouched) :]
        return tokens.with_patch(
            untouched + tuple(tap + update.to(tap.dtype) for tap, update in zip(changed, updates, strict=True))
        )

    def _embed(self, tokens: Tokens) -> Tensor:
        """Features of the last tap on the upsampled grid, ``[B V h w, C]``."""
        features = self.embed(tokens.patch[-1].float())  # [B, V, P, C]
        features = features.flatten(0, 1).unflatten(1, tokens.grid).permute(0, 3, 1, 2)  # [B V, C, rows, columns]
        features = F.interpolate(features, scale_factor=self.upsample, mode="bilinear", align_corners=False)
        return features.permute(0, 2, 3, 1).flatten(0, 2)  # [B V h w, C]

    def _enhance(
        self, embedded: Tensor, points: PatchPoints, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        """Pools to voxels, runs PTv3, interpolates at the points: features ``[N, C]`` and gate ``[B, 1, 1, 1]``."""
        with full_precision(embedded):
            plan = plan_voxels(points.cells, points.batch)
            pooled = pool_mean(embedded, points.confidence, plan)  # f_m^v, eqn voxelfeature: [M, C]
            least = pool_min(points.confidence, plan)  # n_m^v, eqn voxelfeature: [M]
            centroid = cell_centroids(points.cells, points.confidence, plan) if self.surface_evidence else None
        inputs = (pooled, least.log()[:, None]) if centroid is None else (pooled, 2 * centroid, least.log()[:, None])
        # S, T and S^-1 of eqn ptvzengqiang: PTv3 serialises, enhances and returns the voxels in input order
        voxels = self.ptv3(torch.cat(inputs, -1), plan.grid, plan.batch, points.voxel_size, generator=generator)
        with full_precision(embedded):
            return self._read_back(voxels.float(), plan, centroid, points)

    def _read_back(
        self, voxels: Tensor, plan: VoxelPlan, centroid: Tensor | None, points: PatchPoints
    ) -> tuple[Tensor, Tensor]:
        """Interpolates the enhanced voxels ``[M, C]`` at the points; returns the same as :meth:`_enhance`."""
        # positions relative to the scene's first cell, so that their differences are precise in float32
        first = torch.searchsorted(plan.batch, torch.arange(len(points.voxel_size), device=plan.batch.device))
        origin = plan.grid[first.clamp(max=len(plan) - 1)]
        queries = (points.cells - origin[points.batch]).float()
        centers = (plan.grid - origin[plan.batch]).float() + 0.5
        # paper, after eqn ptvzengqiang: distance-weighted over the 16 nearest voxel centres
        index, weights = interpolation_weights(
            queries, points.batch, centers, plan.batch, self.neighbors, len(points.voxel_size)
        )  # [N, k]
        enhanced = interpolate(voxels, index, weights)  # [N, C]
        gain = torch.ones_like(points.voxel_size)
        if centroid is not None:
            evidence = torch.where(weights > 0, voxel_evidence(points.confidence, plan)[index], 0)
            to_surface = vectors_to_surface(queries, centers + centroid, evidence, index)
            frames = PointFrames(points.depth, points.cameras, points.rows)
            seen = frames.in_camera(to_surface, points.voxel_size[points.batch])
            if points.clear is not None:  # nothing is known near silhouettes
                seen = torch.where(points.clear[:, None], seen, 0)
                gain = gate(disagreement(seen[:, -1], points.clear, points.batch, len(gain)))
            enhanced = torch.cat((enhanced, seen, points.confidence.log()[:, None]), -1)
        return enhanced, gain[:, None, None, None]

    def _to_patches(self, features: Tensor, points: PatchPoints, tokens: Tokens) -> tuple[Tensor, Tensor]:
        """Averages the valid points of every patch: ``[B, V, P, C]``, and whether it has any: ``[B, V, P, 1]``."""
        views = tokens.patch[-1].shape[:2]
        rows, columns = tokens.grid
        total = views.numel() * rows * columns * self.upsample**2
        weighted = torch.cat((features, torch.ones_like(features[:, :1])), -1)  # [N, C + 1]
        if points.placeholder:
            weighted = weighted * 0
        dense = weighted.new_zeros(total, weighted.shape[1]).index_copy(0, points.rows, weighted)  # [B V h w, C + 1]
        dense = dense.view(*views, rows, self.upsample, columns, self.upsample, -1).sum((3, 5))
        dense = dense.flatten(2, 3)  # [B, V, P, C + 1]
        count = dense[..., -1:]
        return dense[..., :-1] / count.clamp(min=1), count > 0


class PatchPoints:
    """Packed points of the upsampled patch grid that have a valid depth.

    A cell's depth is that of its central pixel, its confidence the smallest of its pixels. If no point is valid, one
    placeholder point keeps the network's parameters in the autograd graph; its features are discarded.

    Args:
        geometry: B scenes of V views, in scene units.
        cell: pixels per cell side.
        voxel_size: ``[B]`` edge length in scene units.
        away_from_silhouettes: whether to compute ``clear``.

    Attributes:
        rows: ``[N]`` index in the flattened ``[B, V, h, w]`` grid.
        batch: ``[N]`` scene index, sorted.
        cells: ``[N, 3]`` float64 positions in voxel units.
        confidence: ``[N]`` > 0.
        depth: ``[B, V, h, w]`` depth of the grid in scene units, 0 = invalid.
        cameras: cameras whose pixels are the grid's cells.
        clear: ``[N]`` bool, true if no pixel of the cell is next to a silhouette; None unless requested.
    """

    def __init__(self, geometry: Geometry, cell: int, voxel_size: Tensor, away_from_silhouettes: bool = False) -> None:
        depth, confidence = geometry.depth.detach().float(), geometry.depth_conf.detach().float()
        sampled = depth[..., cell // 2 :: cell, cell // 2 :: cell]  # [B, V, h, w]
        smallest = -F.max_pool2d(-confidence, cell)  # [B, V, h, w]
        valid = torch.isfinite(sampled) & (sampled > 0) & torch.isfinite(smallest) & (smallest > 0)
        self.voxel_size = voxel_size
        self.depth = torch.where(valid, sampled, 0.0)
        self.cameras = _sampled_cameras(geometry.cameras, cell, (sampled.shape[-2], sampled.shape[-1]))
        points = unproject(torch.where(valid, sampled, 1.0), self.cameras)  # [B, V, h, w, 3]
        scene = torch.arange(len(depth), device=depth.device).repeat_interleave(sampled[0].numel())  # [B V h w]
        cells = point_cells(points.flatten(0, -2), scene, voxel_size)  # [B V h w, 3]
        usable = valid.flatten() & in_range(cells)
        self.rows = usable.nonzero()[:, 0]
        self.placeholder = not len(self.rows)
        if self.placeholder:
            self.rows = scene.new_zeros(1)
        self.batch = scene[self.rows]
        self.cells = cells[self.rows] if not self.placeholder else cells.new_zeros(1, 3)
        self.confidence = torch.where(valid, smallest, 1.0).flatten()[self.rows]
        self.clear: Tensor | None = None
        if away_from_silhouettes:
            near = near_silhouettes(torch.where(torch.isfinite(depth), depth, 0.0)).to(depth.dtype)
            self.clear = (F.max_pool2d(near, cell) == 0).flatten()[self.rows]


def _to_patch_rows(maps: Tensor, seen: Tensor) -> Tensor:
    """Maps ``[B V, C, rows, columns]`` to patch rows ``[B, V, P, C]``, 0 where not ``seen`` ``[B, V, P, 1]``."""
    rows = maps.flatten(2).transpose(1, 2).unflatten(0, seen.shape[:2])  # [B, V, P, C]
    return torch.where(seen, rows, 0)


def _sampled_cameras(cameras: Cameras, cell: int, size: tuple[int, int]) -> Cameras:
    """Returns cameras whose pixels are the cells' central pixels."""
    intrinsics = strided_intrinsics(cameras.intrinsics.detach().float(), cell, cell)
    return Cameras(cameras.world_to_camera.detach().float(), intrinsics, size)
