"""Fine-level voxels: dense features of all views pooled into small cells and refined (paper, Fine-level decoding)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from vg2gt.geometry.cameras import camera_centers, focal_lengths, unproject
from vg2gt.geometry.precision import Float32Linear, full_precision
from vg2gt.geometry.symmetric import UPPER
from vg2gt.kernels.point_features import PooledFeatures
from vg2gt.kernels.threads import compilable
from vg2gt.memory import Cap, note_sizes
from vg2gt.method.additions.point_moments import COLUMNS, pool_point_moments
from vg2gt.method.additions.silhouette import on_surface
from vg2gt.method.additions.voxel_normals import surface_normals
from vg2gt.method.dense_head import DenseHead
from vg2gt.method.grid import (
    VoxelPlan,
    in_range,
    plan_voxels,
    point_cells,
    pool_mean,
    pool_mean_of_chunks,
    pool_min,
    pool_sum,
    scene_counts,
    scene_voxel_size,
)
from vg2gt.method.point_mlp import PointMLP
from vg2gt.method.pooled import PooledVoxels
from vg2gt.types import Geometry, Tokens, VoxelMoments, Voxels

log = logging.getLogger(__name__)

_EXTRA_CHANNELS = 8  # colour (3), position of the centroid in the cell (3), number of points (1), confidence (1)
_MOMENT_CHANNELS = 15  # spread (6), covariance with colour (9)
# Scale inputs of the voxel network to about [-1, 1]; the spread of a uniformly filled cell is 1 / 12.
_SPREAD_SCALE, _CROSS_SCALE = 12, 20


class FineModule(nn.Module):
    """Pools the dense features, colours and positions of all pixels into voxels and refines them.

    A pixel's position within its cell is added to its feature before pooling, so that the pooled feature encodes how
    the surface passes through the cell.

    Args:
        token_dims: width of each tapped layer.
        patch_size: pixels per patch side.
        dense_head: factory of the dense head, called with ``token_dims`` and ``patch_size``.
        point_mlp: factory of the voxel network, called with ``in_channels``.
        voxel_size: edge length in scene units.
        min_footprint: smallest edge in pixels at the scene's median depth; 0 disables this bound.
        footprint_view: longer side in pixels above which views count as reduced to it in ``min_footprint``: larger
            views then improve the depth, but add no voxels. None: views count as they are.
        coarsest_drawn: training multiplies the smallest edge by a factor drawn log-uniformly from 1 to this value, so
            that one head supports several voxel sizes.
        max_voxels: largest number of voxels per scene; above it the least confident are dropped, with a warning in the
            log and the metric ``train/voxels_dropped``. None keeps all.
        moments: whether to pool second moments of the points too, as further inputs of the voxel network and for the
            surfel start of the Gaussian head.
        normal_kernel: edge length in cells, 1 or 3, of the neighbourhood whose points determine a voxel's normal
            (:mod:`vg2gt.method.additions.voxel_normals`).
        drop_fringes: whether to leave out pixels between foreground and background
            (:mod:`vg2gt.method.additions.silhouette`).

    Attributes:
        out_channels: width of the refined features.
        cap: counts the voxels that ``max_voxels`` drops.

    Raises:
        ValueError: if ``max_voxels``, ``footprint_view`` or ``coarsest_drawn`` is below 1, or ``normal_kernel`` is
            neither 1 nor 3.
    """

    def __init__(
        self,
        token_dims: Sequence[int],
        patch_size: int,
        dense_head: Callable[..., DenseHead],
        point_mlp: Callable[..., PointMLP],
        voxel_size: float = 0.002,
        min_footprint: float = 1.0,
        footprint_view: int | None = None,
        coarsest_drawn: float = 1.0,
        max_voxels: int | None = None,
        moments: bool = False,
        normal_kernel: int = 1,
        drop_fringes: bool = False,
    ) -> None:
        super().__init__()
        if normal_kernel not in (1, 3):
            raise ValueError(f"model.fine.normal_kernel must be 1 or 3, got {normal_kernel}")
        if not coarsest_drawn >= 1:
            raise ValueError(f"model.fine.coarsest_drawn must be at least 1, got {coarsest_drawn}")
        if footprint_view is not None and footprint_view < 1:
            raise ValueError(f"model.fine.footprint_view must be at least 1, or null, got {footprint_view}")
        self.voxel_size = voxel_size
        self.min_footprint = min_footprint
        self.footprint_view = footprint_view
        self.coarsest_drawn = coarsest_drawn
        self.cap = Cap("model.fine.max_voxels", max_voxels, "voxels", "least confident")
        self.dense_head = dense_head(token_dims=token_dims, patch_size=patch_size)
        width = self.dense_head.out_channels
        self.point_offset = Float32Linear(3, width, bias=False)
        self.moments = moments
        self.normal_kernel = normal_kernel
        self.drop_fringes = drop_fringes
        self.point_mlp = point_mlp(in_channels=width + _EXTRA_CHANNELS + _MOMENT_CHANNELS * moments)
        self.out_channels = self.point_mlp.out_channels

    def voxel_edges(self, geometry: Geometry, coarsen: Tensor | None = None) -> Tensor:
        """Returns the edge ``[B]`` of each scene's voxels in scene units.

        Args:
            geometry: as for :meth:`pool`.
            coarsen: ``[B]`` factors on the smallest edge; None: 1.
        """
        if self.training and self.coarsest_drawn > 1:
            drawn = self.coarsest_drawn ** torch.rand(len(geometry.depth), device=geometry.depth.device)
            coarsen = drawn if coarsen is None else coarsen * drawn
        larger = 1.0 if self.footprint_view is None else max(1.0, max(geometry.cameras.size) / self.footprint_view)
        with full_precision(geometry.depth):
            return scene_voxel_size(geometry, self.voxel_size, larger * self.min_footprint, coarsen)

    def pool(
        self, tokens: Tokens, geometry: Geometry, images: Tensor, size: Tensor, capped: bool = True
    ) -> PooledVoxels:
        """Pools the pixels of B scenes, or of some views of them; such parts can be merged.

        Args:
            tokens: enhanced tokens.
            geometry: decoded depth, confidence and cameras, in scene units and the frame of context view 0.
            images: ``[B, V, 3, H, W]`` in [0, 1].
            size: ``[B]`` result of :meth:`voxel_edges` for the whole scenes.
            capped: whether ``max_voxels`` applies now; for parts, it applies once they are merged (:meth:`limited`).

        Returns:
            The voxels; differentiable in features, confidence and positions, but not in the assignment of pixels.

        Raises:
            ValueError: if a scene spans too many voxels to index.
        """
        # pixels to points and their cells
        with full_precision(images):
            points = _Points(geometry, size, self.drop_fringes)
            plan = plan_voxels(points.cells, points.batch, points.valid, points.valid_count)
            note_sizes({"voxels": len(plan)})
            if capped and self.cap.limit is not None:
                keep = self.cap(pool_min(points.confidence.detach(), plan), plan.batch)
                plan = plan if keep is None else plan.select(keep)
        # dense features to voxels: [M, C]
        features = self._pool_features(tokens, images, points, plan)
        # position, colour, confidence and second moments of the points in every voxel
        with full_precision(images):
            pixels = images.float().permute(0, 1, 3, 4, 2).reshape(-1, 3)  # [B V H W, 3]
            values = torch.cat((points.offset, pixels), -1)  # [B V H W, 6]
            means = pool_mean(values, points.confidence, plan)
            confidence = pool_min(points.confidence, plan)
            moments = self._pool_moments(geometry, size, values, points.confidence, means, plan)
            weight = pool_sum(points.confidence.detach().double(), plan)
        return PooledVoxels(plan.grid, plan.batch, plan.counts, weight, confidence, features, means, moments)

    def limited(self, pooled: PooledVoxels) -> PooledVoxels:
        """Applies ``max_voxels`` to merged voxels."""
        keep = self.cap(pooled.confidence, pooled.batch)
        return pooled if keep is None else pooled.rows(keep)

    def refine(self, pooled: PooledVoxels, size: Tensor) -> Voxels:
        """Refines the voxels of B whole scenes.

        Args:
            pooled: result of :meth:`pool`, or several of them merged.
            size: as for :meth:`pool`.
        """
        plan, means, confidence = pooled.plan(), pooled.means, pooled.confidence
        note_sizes({"voxels": len(pooled)})
        with full_precision(pooled.features):
            offset, colors = means.split(3, -1)
            count = plan.counts.to(pooled.features.dtype)
            density = torch.log(count / _scene_medians(count, plan.batch, len(size)))
            extra = [2 * colors - 1, 2 * offset, density[:, None], confidence.log()[:, None]]
            # adding before scaling keeps the centroid inside its cell in float32
            centroid = (plan.grid + 0.5 + offset.double()) * size.double()[plan.batch, None]
            centroid = centroid.to(pooled.features.dtype)
            moments = None
            if pooled.moments is not None:
                moments = self._moments(pooled.moments, means, centroid, plan)
                spread = [moments.spread[:, i, j] for i, j in zip(*UPPER, strict=True)]
                extra += [_SPREAD_SCALE * torch.stack(spread, -1), _CROSS_SCALE * moments.cross.flatten(1)]
        refined = self.point_mlp(torch.cat((pooled.features, *extra), -1), plan.grid, plan.batch, size)
        return Voxels(refined, colors, plan.grid, plan.batch, confidence, count, centroid, size, moments)

    @torch.no_grad()
    def _pool_moments(
        self, geometry: Geometry, size: Tensor, values: Tensor, confidence: Tensor, means: Tensor, plan: VoxelPlan
    ) -> Tensor | None:
        """Returns second moments ``[M, 22]`` of the points' positions and colours ``[N, 6]`` about their means."""
        if not self.moments:
            return None
        centers = camera_centers(geometry.cameras).float()  # [B, V, 3]
        focal = focal_lengths(geometry.cameras.intrinsics).mean(-1).float()  # [B, V]
        views = torch.cat((centers, (focal * size[:, None])[..., None]), -1).flatten(0, 1)  # [B V, 4]
        depth, chunk = geometry.depth.float().flatten(), self.dense_head.views_per_chunk
        return pool_point_moments(values, depth, confidence, views, means, plan, chunk)

    @torch.no_grad()
    def _moments(self, pooled: Tensor, means: Tensor, centroid: Tensor, plan: VoxelPlan) -> VoxelMoments:
        both, eye, pixel = pooled.split(COLUMNS, -1)
        spread, cross = both.unflatten(-1, (3, 6)).split(3, -1)
        facing = F.normalize(eye - centroid, dim=-1)
        normal = surface_normals(spread, facing, means[:, :3], plan, self.normal_kernel)
        return VoxelMoments(spread, cross, facing, pixel[:, 0], normal)

    def _pool_features(self, tokens: Tokens, images: Tensor, points: _Points, plan: VoxelPlan) -> Tensor:
        """Pools dense features to ``[M, C]``; without gradient, a few views at a time, which bounds the memory."""
        weight = self.point_offset.weight
        if torch.is_grad_enabled() or not len(plan):
            dense = _pixel_rows(self.dense_head(tokens, images))
            return pool_point_features(dense, points.offset, weight, points.confidence, plan)
        offsets = points.offset.split(self.dense_head.views_per_chunk * images[0, 0, 0].numel())
        # not a generator, which would hold a chunk while the next is computed
        chunks = map(
            lambda dense, offset: point_features(_pixel_rows(dense), offset, weight),
            self.dense_head.chunks(tokens, images),
            offsets,
        )
        return pool_mean_of_chunks(chunks, points.confidence, plan)


def _pixel_rows(dense: Tensor) -> Tensor:
    """Maps ``[n, C, H, W]`` to float32 rows ``[n H W, C]``."""
    return dense.permute(0, 2, 3, 1).flatten(0, 2).float()


class _Points:
    """All pixels as points for :func:`plan_voxels`; invalid ones are finite placeholders that no voxel uses."""

    def __init__(self, geometry: Geometry, voxel_size: Tensor, drop_fringes: bool) -> None:
        depth, confidence = geometry.depth.float(), geometry.depth_conf.float()
        usable = torch.isfinite(depth) & (depth > 0) & torch.isfinite(confidence) & (confidence > 0)
        if drop_fringes:
            usable = usable & on_surface(torch.where(usable, depth.detach(), 0.0))
        points = unproject(torch.where(usable, depth, 1.0), geometry.cameras).flatten(0, -2)
        scenes, per_scene = len(depth), depth[0].numel()
        self.batch = torch.arange(scenes, device=depth.device).repeat_interleave(per_scene)
        self.confidence = torch.where(usable, confidence, 1.0).flatten()
        self.cells = point_cells(points, self.batch, voxel_size)
        near = in_range(self.cells.detach())
        self.valid = usable.flatten() & near
        self.offset = (self.cells - self.cells.detach().floor() - 0.5).float()
        far, self.valid_count = torch.stack(((usable.flatten() & ~near).sum(), self.valid.sum())).tolist()
        if far:
            log.warning("ignored %d of %d points: too far from the origin for the voxel grid", far, usable.numel())


def _scene_medians(values: Tensor, batch: Tensor, scenes: int) -> Tensor:
    """Returns for every voxel the median of the ``[M]`` values in its scene: ``[M]``."""
    parts = values.split(scene_counts(batch, scenes).tolist())
    return torch.stack([part.median() if len(part) else part.new_ones(()) for part in parts])[batch]


def pool_point_features(dense: Tensor, offset: Tensor, weight: Tensor, confidence: Tensor, plan: VoxelPlan) -> Tensor:
    """Returns ``sum n gelu(f + W o) / sum n`` over the points in every voxel (paper, eqn voxelfeature).

    Args:
        dense: ``[N, C]`` dense features f of the pixels.
        offset: ``[N, 3]`` positions o within their cells, in [-1/2, 1/2].
        weight: ``[C, 3]`` linear layer W from position to feature.
        confidence: ``[N]`` n > 0.
        plan: the voxels.

    Returns:
        ``[M, C]``, differentiable in all tensors. Compiled if they are float32 on a CPU: separate operations allocate
        four arrays of all pixels' features.
    """
    if len(plan) and compilable(dense, offset, weight, confidence):
        places = (plan.order, plan.starts, plan.counts, plan.voxel_of)
        return PooledFeatures.apply(dense, offset, weight, confidence, *places)  # pyright: ignore[reportReturnType]
    return pool_mean(point_features(dense, offset, weight), confidence, plan)


def point_features(dense: Tensor, offset: Tensor, weight: Tensor) -> Tensor:
    """Returns ``gelu(dense + offset W^T)``, ``[N, C]``, in float32 under any autocast."""
    with torch.autocast(dense.device.type, enabled=False):
        return F.gelu(torch.addmm(dense.float(), offset, weight.t()))
