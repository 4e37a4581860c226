"""Renderer over sparse (pixel, Gaussian) pairs in plain torch: any device, no other packages."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from vg2gt.kernels.constants import ALPHA_MIN, TRANSMITTANCE_STOP
from vg2gt.rendering.median import Rays, ray_depth
from vg2gt.rendering.options import Images, RenderOptions, SceneViews
from vg2gt.rendering.projection import Splats, list_cells, pixel_boxes, respond, visible_splats


@dataclass(frozen=True)
class PairRays(Rays):
    """Hits in one list ``[N]``.

    Attributes:
        pixel: ``[N]`` int64 ray index of each hit, sorted.
        count: number of rays.
    """

    pixel: Tensor
    count: int

    def sum(self, hits: Tensor) -> Tensor:
        """See :class:`Rays`."""
        return hits.new_zeros(self.count, *hits.shape[1:]).index_add(0, self.pixel, hits)

    def amin(self, hits: Tensor) -> Tensor:
        """See :class:`Rays`."""
        return hits.new_full((self.count,), torch.inf).scatter_reduce(0, self.pixel, hits, "amin")

    def amax(self, hits: Tensor) -> Tensor:
        """See :class:`Rays`."""
        return hits.new_full((self.count,), -torch.inf).scatter_reduce(0, self.pixel, hits, "amax")

    def expand(self, rays: Tensor) -> Tensor:
        """See :class:`Rays`."""
        return rays[self.pixel]

    def running_sum(self, hits: Tensor) -> Tensor:
        """Inclusive cumulative sum within each ray, in float64 because one pass sums all rays."""
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
    pixels = torch.stack((rays.pixel % width, rays.pixel // width), -1).to(hits.depth.dtype)  # [N, 2]
    response, peak, precision = respond(hits, pixels)
    alpha = response.clamp(max=options.alpha_max)
    passed = torch.log1p(-alpha)
    before = torch.exp(rays.running_sum(passed) - passed).to(alpha.dtype)
    weight = alpha * before  # [N], paper, eqn 3dgs_render_preliminary
    final = torch.exp(rays.sum(passed.double())).to(alpha.dtype)
    color = rays.sum(weight[:, None] * hits.color) + final[:, None] * scene.background  # [H * W, 3]
    normal, depth = torch.zeros_like(color), torch.zeros_like(final)
    if options.geometry:
        normal = rays.sum(weight[:, None] * hits.normal)
        depth = ray_depth(alpha, weight, before.detach(), final, peak, precision, rays, options)
    shape = (1, height, width)
    return Images(color.view(*shape, 3), normal.view(*shape, 3), depth.view(shape), (1 - final).view(shape))


def _hits(splats: Splats, box: Tensor, size: tuple[int, int], options: RenderOptions) -> tuple[Tensor, PairRays]:
    """Lists all hits, sorted by pixel and front to back within a pixel: splat index ``[N]`` and the rays."""
    height, width = size
    first, last = pixel_boxes(box, size)
    index, cells = list_cells(first, (last - first + 1).clamp(min=0))
    pixel = cells[:, 1] * width + cells[:, 0]
    response, _, _ = respond(splats[index], cells.to(splats.depth.dtype))
    kept = response >= ALPHA_MIN
    pixel, order = torch.sort(pixel[kept], stable=True)
    index, response = index[kept][order], response[kept][order]
    rays = PairRays(pixel, height * width)
    after = rays.running_sum(torch.log1p(-response.clamp(max=options.alpha_max)))
    kept = after >= math.log(TRANSMITTANCE_STOP)
    return index[kept], PairRays(pixel[kept], height * width)
