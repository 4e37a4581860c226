"""Coarse-level feature enhancement: patch tokens gain what voxels shared by all views know (paper, Coarse-level)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, get_args

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from vg2gt.geometry.cameras import crop_intrinsics, ray_directions, unproject
from vg2gt.geometry.normals import normals_from_depth
from vg2gt.types import Cameras, Geometry, Tokens
from vg2gt.voxels.grid import in_range, plan_voxels, point_cells, pool_mean, pool_min, scene_voxel_size
from vg2gt.voxels.knn import interpolate, interpolation_weights
from vg2gt.voxels.ptv3 import PTv3

Inject = Literal["last", "all"]
VOXEL_CHANNELS = 4  # centroid in the cell (3), confidence
POINT_CHANNELS = 5  # from a point to the surface around it: a vector in camera axes (3), a change of depth; confidence
SURFACE_WIDTH = 2.0  # voxels, of the Gaussian that weighs the voxels around a point
DEPTH_CHANGE_UNIT = 0.02  # relative
MAX_DEPTH_CHANGE = 3.0  # units
GRAZING = 0.2  # product of normal and ray below which the change of depth says nothing
NORMAL_EDGE = 0.2  # relative depth step across which no normal is taken


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
        fuse_channels: width of the fusing convolutions on the patch grid.
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
        width = self.ptv3.out_channels + hidden[-1] + POINT_CHANNELS
        self.fuse = nn.Sequential(
            nn.Conv2d(width, fuse_channels, 3, padding=1),
            nn.GELU(),
            nn.Conv2d(fuse_channels, fuse_channels, 3, padding=1),
            nn.GELU(),
        )
        self.zero = nn.ModuleList(
            nn.Conv2d(fuse_channels, token_dim, 1) for _ in range(num_taps if inject == "all" else 1)
        )
        for parameter in self.zero.parameters():
            nn.init.zeros_(parameter)

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
            fused = self.fuse(_to_maps(patches, tokens.grid))
            updates = [torch.where(seen, _to_rows(branch(fused), patches), 0) for branch in self.zero]
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
        """PTv3 over the voxels, read back at the points: ``[N, C]`` features, then ``POINT_CHANNELS`` more."""
        everything = torch.ones_like(points.batch, dtype=torch.bool)
        plan = plan_voxels(points.cells, points.batch, everything)
        offset = (points.cells - points.cells.floor() - 0.5).float()
        centroid = pool_mean(offset, points.confidence, plan)
        confidence = pool_min(points.confidence, plan)
        inputs = (pool_mean(embedded, points.confidence, plan), 2 * centroid, confidence.log()[:, None])
        voxels = self.ptv3(torch.cat(inputs, -1), plan.grid, plan.batch, points.voxel_size, generator=generator)
        # Cells relative to their scene's first one: differences, and so the weights, keep their precision in float32.
        first = torch.searchsorted(plan.batch, torch.arange(len(points.voxel_size), device=plan.batch.device))
        origin = plan.grid[first.clamp(max=len(plan) - 1)]
        queries = (points.cells - origin[points.batch]).float()
        centers = (plan.grid - origin[plan.batch]).float() + 0.5
        index, weights = interpolation_weights(queries, points.batch, centers, plan.batch, self.neighbors)
        evidence = torch.zeros_like(confidence).index_add_(0, plan.voxel_of, points.confidence.square())
        residual = _to_surface(queries, centers + centroid, torch.where(weights > 0, evidence[index], 0), index)
        enhanced = interpolate(voxels, index, weights)
        return torch.cat((enhanced, points.in_camera(residual), points.confidence.log()[:, None]), -1)

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
        depth: ``[N]`` scene units.
        ray: ``[N, 3]`` the point's ray in its camera's axes, z = 1.
        normal: ``[N, 3]`` the surface normal there, facing the camera; where it is unknown, the camera's axis.
        placeholder: whether the only point is the placeholder.
        voxel_size: ``[B]``.
    """

    def __init__(self, geometry: Geometry, cell: int, voxel_size: Tensor) -> None:
        depth, confidence = geometry.depth.detach().float(), geometry.depth_conf.detach().float()
        sampled = depth[..., cell // 2 :: cell, cell // 2 :: cell]
        smallest = -F.max_pool2d(-confidence, cell)
        valid = torch.isfinite(sampled) & (sampled > 0) & torch.isfinite(smallest) & (smallest > 0)
        size = (sampled.shape[-2], sampled.shape[-1])
        cameras = _sampled_cameras(geometry.cameras, cell, size)
        points = unproject(torch.where(valid, sampled, 1.0), cameras)
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
        self.depth = torch.where(valid, sampled, 1.0).flatten()[self.rows]
        self.ray = ray_directions(cameras.intrinsics, size).flatten(0, -2)[self.rows]
        normals, known = normals_from_depth(torch.where(valid, sampled, 0.0), cameras.intrinsics, NORMAL_EDGE)
        normals = torch.where(known[:, :, None], normals, normals.new_tensor([0.0, 0.0, -1.0])[:, None, None])
        self.normal = normals.permute(0, 1, 3, 4, 2).flatten(0, -2)[self.rows]

    def in_camera(self, residual: Tensor) -> Tensor:
        """A residual ``[N, 3]`` (world axes, voxels) in the cameras' axes and as a change of depth: ``[N, 4]``.

        The change of depth takes the point along its ray onto the tangent plane through the residual's end, so that
        where on the surface the neighbours happen to lie drops out: what remains is how far the views disagree.
        """
        local = (self.rotation @ residual[..., None])[..., 0]
        facing = (self.normal * self.ray).sum(-1)
        steps = (self.normal * local).sum(-1) / facing.clamp(max=-GRAZING)
        change = steps * self.voxel_size[self.batch] / (self.depth * DEPTH_CHANGE_UNIT)
        change = torch.where(facing < -GRAZING, change, 0.0).clamp(-MAX_DEPTH_CHANGE, MAX_DEPTH_CHANGE)
        return torch.cat((local, change[:, None]), -1)


def _to_surface(queries: Tensor, centroids: Tensor, evidence: Tensor, index: Tensor) -> Tensor:
    """From every point to the surface that all views agree on around it, ``[N, 3]`` in voxels.

    The features' inverse-square weights would return the point's own voxel; a Gaussian of the distance keeps several,
    and confident points, of which the square of the confidence is the evidence, outweigh the others.
    """
    offset = centroids[index] - queries[:, None]
    weights = evidence * torch.exp(offset.square().sum(-1) / (-2 * SURFACE_WIDTH**2))
    weights = weights / weights.sum(1, keepdim=True).clamp(min=1e-12)
    return (weights[..., None] * offset).sum(1)


def _to_maps(patches: Tensor, grid: tuple[int, int]) -> Tensor:
    """Patch rows ``[B, V, P, C]`` as maps ``[B V, C, rows, columns]``."""
    return patches.flatten(0, 1).transpose(1, 2).unflatten(-1, grid)


def _to_rows(maps: Tensor, like: Tensor) -> Tensor:
    """Maps ``[B V, C, rows, columns]`` as patch rows ``[B, V, P, C]``."""
    return maps.flatten(2).transpose(1, 2).unflatten(0, like.shape[:2])


def _sampled_cameras(cameras: Cameras, cell: int, size: tuple[int, int]) -> Cameras:
    """Cameras whose pixels are the central pixels of the cells (sampled, so pixel centres scale, not areas)."""
    intrinsics = crop_intrinsics(cameras.intrinsics.detach().float(), cell // 2, cell // 2)
    intrinsics = torch.cat((intrinsics[..., :2, :] / cell, intrinsics[..., 2:, :]), -2)
    return Cameras(cameras.world_to_camera.detach().float(), intrinsics, size)
