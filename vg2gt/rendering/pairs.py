"""Sparse (pixel, Gaussian) pairs in plain torch: any device, no further packages."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from vg2gt.rendering.median import MedianDepth
from vg2gt.rendering.options import ALPHA_MIN, TRANSMITTANCE_STOP, Images, RenderOptions, SceneViews
from vg2gt.rendering.projection import Splats, respond, visible_splats


@dataclass(frozen=True)
class PairRays:
    """Hits in one list; ``pixel`` names the ray of each.

    Attributes:
        pixel: ``[N]`` int64, sorted.
        count: number of rays.
    """

    pixel: Tensor
    count: int

    def sum(self, hits: Tensor) -> Tensor:
        """Sum over every ray's hits."""
        return hits.new_zeros(self.count, *hits.shape[1:]).index_add(0, self.pixel, hits)

    def amin(self, hits: Tensor) -> Tensor:
        """Minimum over every ray's hits."""
        return hits.new_full((self.count,), torch.inf).scatter_reduce(0, self.pixel, hits, "amin")

    def amax(self, hits: Tensor) -> Tensor:
        """Maximum over every ray's hits."""
        return hits.new_full((self.count,), -torch.inf).scatter_reduce(0, self.pixel, hits, "amax")

    def spread(self, rays: Tensor) -> Tensor:
        """One value a ray, repeated for every hit."""
        return rays[self.pixel]

    def running_sum(self, hits: Tensor) -> Tensor:
        """Inclusive sum within every ray, in float64 because the rays are summed in one pass."""
        total = torch.cumsum(hits.double(), 0)
        starts = torch.searchsorted(self.pixel, self.pixel)
        return total - torch.where(starts > 0, total[(starts - 1).clamp(min=0)], 0.0)


def rasterize_pairs(scene: SceneViews, options: RenderOptions) -> Images:
    """Renders every view; differentiable in every tensor of the scene."""
    return Images.stack([_render_view(scene.view(index), options) for index in range(len(scene.world_to_camera))])


def _render_view(scene: SceneViews, options: RenderOptions) -> Images:
    height, width = scene.size
    splats, box = visible_splats(scene, options)
    with torch.no_grad():
        index, rays = _hits(splats, box, scene.size, options)
    hits = splats[index]
    response, peak, precision = respond(hits, _pixels(rays.pixel, width, peak_like=hits.depth))
    alpha = response.clamp(max=options.alpha_max)
    passed = torch.log1p(-alpha)
    before = torch.exp(rays.running_sum(passed) - passed).to(alpha.dtype)
    weight = alpha * before
    final = torch.exp(rays.sum(passed.double())).to(alpha.dtype)
    color = rays.sum(weight[:, None] * hits.color) + final[:, None] * scene.background
    normal, depth = torch.zeros_like(color), torch.zeros_like(final)
    if options.geometry:
        normal = rays.sum(weight[:, None] * hits.normal)
        depth = _depth(alpha, weight, before.detach(), final, peak, precision, rays, options)
    shape = (1, height, width)
    return Images(color.view(*shape, 3), normal.view(*shape, 3), depth.view(shape), (1 - final).view(shape))


def _pixels(pixel: Tensor, width: int, peak_like: Tensor) -> Tensor:
    return torch.stack((pixel % width, pixel // width), -1).to(peak_like.dtype)


def _hits(splats: Splats, box: Tensor, size: tuple[int, int], options: RenderOptions) -> tuple[Tensor, PairRays]:
    """Lists all hits, sorted by pixel and front to back within a pixel: splat index ``[N]`` and the rays."""
    height, width = size
    low = box[:, :2].ceil().clamp(min=0).long()
    limit = torch.tensor([width - 1, height - 1], device=box.device)
    extent = (torch.minimum(box[:, 2:].floor().clamp(min=-1).long(), limit) - low + 1).clamp(min=0)
    area = extent.prod(-1)
    index = torch.repeat_interleave(area)
    cell = torch.arange(len(index), device=box.device) - (torch.cumsum(area, 0) - area)[index]
    columns = extent[index, 0]
    pixel = (low[index, 1] + cell // columns) * width + low[index, 0] + cell % columns
    response, _, _ = respond(splats[index], _pixels(pixel, width, peak_like=splats.depth))
    kept = response >= ALPHA_MIN
    pixel, order = torch.sort(pixel[kept], stable=True)
    index, response = index[kept][order], response[kept][order]
    rays = PairRays(pixel, height * width)
    after = rays.running_sum(torch.log1p(-response.clamp(max=options.alpha_max)))
    kept = after >= math.log(TRANSMITTANCE_STOP)
    return index[kept], PairRays(pixel[kept], height * width)


def _depth(
    alpha: Tensor,
    weight: Tensor,
    before: Tensor,
    final: Tensor,
    peak: Tensor,
    precision: Tensor,
    rays: PairRays,
    options: RenderOptions,
) -> Tensor:
    if options.mode == "solid":
        depth = MedianDepth.apply(alpha, peak, precision, before, rays, options)
        assert isinstance(depth, Tensor)
        return depth
    if options.depth == "expected":
        covered = 1 - final
        hit = covered.detach() > 0
        return torch.where(hit, rays.sum(weight * peak) / torch.where(hit, covered, 1.0), 0.0)
    crossing = (before > 0.5) & (before * (1 - alpha.detach()) <= 0.5)
    return rays.sum(crossing * peak)
