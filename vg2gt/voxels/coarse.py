"""Coarse-level feature enhancement: patch tokens gain what voxels shared by all views know (paper, Coarse-level)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, get_args

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from vg2gt.geometry.cameras import crop_intrinsics, unproject
from vg2gt.types import Cameras, Geometry, Tokens
from vg2gt.voxels.grid import in_range, plan_voxels, point_cells, pool_mean, pool_min, scene_voxel_size
from vg2gt.voxels.knn import interpolate, interpolation_weights
from vg2gt.voxels.ptv3 import PTv3

Inject = Literal["last", "all"]
VOXEL_CHANNELS = 4  # centroid in the cell (3), confidence
RESIDUAL_CHANNELS = 3  # from a point to the weighted mean of the surface around it, in its camera's axes


class CoarseModule(nn.Module):
    """Enhances patch tokens by PTv3 over coarse voxels, fused through a zero-initialised projection.

    Positions are detached: the module reads the frozen backbone's geometry, it does not move it. A patch without a
    valid point keeps its tokens.

    Args:
        token_dim: width of the tapped patch tokens.
        num_taps: number of tapped layers.
        patch_size: pixels a patch, a multiple of ``upsample``.
        ptv3: makes the voxel network from ``in_channels``.
        voxel_size: edge length in scene units.
        min_footprint: smallest edge in pixels at the scene's median depth; 0 switches the guard off.
        hidden: widths of the MLP from tokens to voxel features.
        fuse_channels: hidden width of the fusing projections.
        neighbors: nearest voxels a point's feature is interpolated from.
        inject: ``all`` changes every tap, ``last`` the last one only.
        upsample: points a patch along each axis.

    Raises:
        ValueError: if ``inject`` is unknown or ``upsample`` does not divide the patch.
    """

    def __init__(
        self,
        token_dim: int,
        num_taps: int,
        patch_size: int,
        ptv3: Callable[..., PTv3],
        voxel_size: float = 0.01,
        min_footprint: float = 0.0,
        hidden: Sequence[int] = (1536, 1024),
        fuse_channels: int = 1024,
        neighbors: int = 16,
        inject: Inject = "all",
        upsample: int = 2,
    ) -> None:
        super().__init__()
        if inject not in get_args(Inject):
            raise ValueError(f"coarse.inject is {inject!r}; choose one of {', '.join(get_args(Inject))}")
        if patch_size % upsample:
            raise ValueError(f"coarse.upsample={upsample} does not divide the backend's patch of {patch_size} pixels")
        self.cell = patch_size // upsample
        self.upsample = upsample
        self.voxel_size = voxel_size
        self.min_footprint = min_footprint
        self.neighbors = neighbors
        layers: list[nn.Module] = [nn.LayerNorm(token_dim)]
        for width_in, width_out in zip((token_dim, *hidden), hidden, strict=False):
            layers += [nn.Linear(width_in, width_out), nn.GELU()]
        self.embed = nn.Sequential(*layers)
        self.ptv3 = ptv3(in_channels=hidden[-1] + VOXEL_CHANNELS)
        width = self.ptv3.out_channels + hidden[-1] + RESIDUAL_CHANNELS
        self.fuse = nn.ModuleList(
            nn.Sequential(nn.Linear(width, fuse_channels), nn.GELU(), nn.Linear(fuse_channels, token_dim))
            for _ in range(num_taps if inject == "all" else 1)
        )
        for branch in self.fuse:
            last: nn.Linear = branch[-1]  # pyright: ignore
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    def forward(self, tokens: Tokens, geometry: Geometry, generator: torch.Generator | None = None) -> Tokens:
        """Enhances tokens.

        Args:
            tokens: the frozen backbone's tokens.
            geometry: geometry decoded from them, in scene units and the frame of context view 0.
            generator: while training, shuffles the serialisation orders.

        Returns:
            The tokens with enhanced patches; bit-equal to the input before training. The camera token is untouched.

        Raises:
            ValueError: if a scene spans too many voxels to be numbered.
        """
        with torch.autocast(geometry.depth.device.type, enabled=False):
            embedded = self._embed(tokens)
            points = _PatchPoints(geometry, self.cell, scene_voxel_size(geometry, self.voxel_size, self.min_footprint))
            enhanced = self._enhance(embedded[points.rows], points, generator)
            patches, seen = self._to_patches(torch.cat((enhanced, embedded[points.rows]), -1), points, tokens)
            updates = [torch.where(seen, branch(patches), 0) for branch in self.fuse]
        untouched = tokens.patch[: len(tokens.patch) - len(updates)]
        changed = tokens.patch[len(untouched) :]
        return tokens.with_patch(
            untouched + tuple(tap + update.to(tap.dtype) for tap, update in zip(changed, updates, strict=True))
        )

    def _embed(self, tokens: Tokens) -> Tensor:
        """Features of the last tap on the upsampled grid, ``[B V h w, C]``."""
        features = self.embed(tokens.patch[-1].float()).flatten(0, 1).unflatten(1, tokens.grid).permute(0, 3, 1, 2)
        features = F.interpolate(features, scale_factor=self.upsample, mode="bilinear", align_corners=False)
        return features.permute(0, 2, 3, 1).flatten(0, 2)

    def _enhance(self, embedded: Tensor, points: _PatchPoints, generator: torch.Generator | None) -> Tensor:
        """PTv3 over the voxels, read back at the points: ``[N, C]`` features and the residual ``[N, 3]``."""
        everything = torch.ones_like(points.batch, dtype=torch.bool)
        plan = plan_voxels(points.cells, points.batch, everything)
        offset = (points.cells - points.cells.floor() - 0.5).float()
        centroid = pool_mean(offset, points.confidence, plan)
        confidence = pool_min(points.confidence, plan)
        inputs = (pool_mean(embedded, points.confidence, plan), 2 * centroid, confidence.log()[:, None])
        voxels = self.ptv3(torch.cat(inputs, -1), plan.grid, plan.batch, points.voxel_size, generator=generator)
        # Cells relative to the first one: differences, and so the weights, keep their precision in float32.
        origin = plan.grid[0]
        queries = (points.cells - origin).float()
        centers = (plan.grid - origin).float() + 0.5
        index, weights = interpolation_weights(queries, points.batch, centers, plan.batch, self.neighbors)
        residual = interpolate(centers + centroid, index, weights) - queries
        local = (points.rotation @ residual[..., None])[..., 0]
        return torch.cat((interpolate(voxels, index, weights), local), -1)

    def _to_patches(self, features: Tensor, points: _PatchPoints, tokens: Tokens) -> tuple[Tensor, Tensor]:
        """Averages the valid points of every patch: ``[B, V, P, C]`` and whether there were any ``[B, V, P, 1]``."""
        views = tokens.patch[-1].shape[:2]
        rows, columns = tokens.grid
        total = views[0] * views[1] * rows * columns * self.upsample**2
        weighted = torch.cat((features, torch.ones_like(features[:, :1])), -1)
        if points.placeholder:
            weighted = weighted * 0
        dense = weighted.new_zeros(total, weighted.shape[1]).index_copy(0, points.rows, weighted)
        dense = dense.view(*views, rows, self.upsample, columns, self.upsample, -1).sum((3, 5)).flatten(2, 3)
        count = dense[..., -1:]
        return dense[..., :-1] / count.clamp(min=1), count > 0


class _PatchPoints:
    """The points of the upsampled patch grid that have a valid depth, packed.

    Depth is taken at the central pixel of every cell, never averaged across an edge; confidence is the smallest of
    the cell. Where nothing at all is valid one placeholder point stands in, so that the network's parameters stay in
    the autograd graph; its features are discarded.

    Attributes:
        rows: ``[N]`` place in the flattened ``[B, V, h, w]`` grid.
        batch: ``[N]`` scene index, sorted.
        cells: ``[N, 3]`` float64 positions in voxel units.
        confidence: ``[N]`` > 0.
        rotation: ``[N, 3, 3]`` world-to-camera rotation of the point's view.
        placeholder: whether the only point is the placeholder.
        voxel_size: ``[B]``.
    """

    def __init__(self, geometry: Geometry, cell: int, voxel_size: Tensor) -> None:
        depth, confidence = geometry.depth.detach().float(), geometry.depth_conf.detach().float()
        sampled = depth[..., cell // 2 :: cell, cell // 2 :: cell]
        smallest = -F.max_pool2d(-confidence, cell)
        valid = torch.isfinite(sampled) & (sampled > 0) & torch.isfinite(smallest) & (smallest > 0)
        size = (sampled.shape[-2], sampled.shape[-1])
        points = unproject(torch.where(valid, sampled, 1.0), _sampled_cameras(geometry.cameras, cell, size))
        scene = torch.arange(len(depth), device=depth.device).repeat_interleave(depth[0].numel() // cell**2)
        cells = point_cells(points.flatten(0, -2), scene, voxel_size)
        usable = valid.flatten() & in_range(cells)
        self.placeholder = not bool(usable.any())
        self.rows = usable.nonzero()[:, 0] if not self.placeholder else scene.new_zeros(1)
        self.batch = scene[self.rows]
        self.cells = cells[self.rows] if not self.placeholder else cells.new_zeros(1, 3)
        self.confidence = torch.where(valid, smallest, 1.0).flatten()[self.rows]
        rotations = geometry.cameras.world_to_camera[..., :3, :3].detach().float().flatten(0, 1)
        self.rotation = rotations[self.rows // (valid[0, 0].numel())]
        self.voxel_size = voxel_size


def _sampled_cameras(cameras: Cameras, cell: int, size: tuple[int, int]) -> Cameras:
    """Cameras whose pixels are the central pixels of the cells (sampled, so pixel centres scale, not areas)."""
    intrinsics = crop_intrinsics(cameras.intrinsics.detach().float(), cell // 2, cell // 2)
    intrinsics = torch.cat((intrinsics[..., :2, :] / cell, intrinsics[..., 2:, :]), -2)
    return Cameras(cameras.world_to_camera.detach().float(), intrinsics, size)
