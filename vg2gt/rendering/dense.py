"""Reference renderer: every pixel against every Gaussian. All other implementations are tested against it."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from vg2gt.geometry.cameras import pixel_grid
from vg2gt.rendering.constants import ALPHA_MIN, TRANSMITTANCE_STOP
from vg2gt.rendering.footprints import note_visible
from vg2gt.rendering.median import ray_depth
from vg2gt.rendering.options import RenderOptions
from vg2gt.rendering.projection import Splats, respond, visible_splats
from vg2gt.rendering.scenes import Images, SceneViews
from vg2gt.types import Footprints

_CELLS_PER_CHUNK = 1 << 21  # pixels times Gaussians held at once


def rasterize_dense(scene: SceneViews, options: RenderOptions) -> Images:
    """Renders every view; differentiable in every tensor of the scene."""
    views = [_render_view(scene.view(index), options) for index in range(len(scene.world_to_camera))]
    color, normal, depth, alpha = (torch.stack(parts) for parts in zip(*views, strict=True))
    return color, normal, depth, alpha


def _render_view(scene: SceneViews, options: RenderOptions) -> Images:
    height, width = scene.size
    splats, index = visible_splats(scene, options)
    if scene.footprints is not None:
        splats = _with_footprints(splats, index, scene.footprints)
    pixels = pixel_grid(height, width, like=scene.means).reshape(-1, 2)  # [H * W, 2]
    chunks = pixels.split(max(1, _CELLS_PER_CHUNK // max(1, len(splats.depth))))
    parts = [
        _render_pixels(_noting(splats, index, len(chunk), scene.footprints), chunk, scene.background, options)
        for chunk in chunks
    ]
    color, normal, depth, alpha = (torch.cat(part) for part in zip(*parts, strict=True))
    return color.view(height, width, 3), normal.view(height, width, 3), depth.view(scene.size), alpha.view(scene.size)


def _with_footprints(splats: Splats, index: Tensor, footprints: Footprints) -> Splats:
    """Notes the splats of one view, and adds the footprints' positions to the graph, as an offset of 0."""
    screen = splats.center, splats.conic, splats.tilt, splats.curvature, splats.cutoff
    note_visible(footprints, 0, index, *screen)
    leaf = footprints.means2d[0, index]
    return replace(splats, center=splats.center + (leaf - leaf.detach()))


def _noting(splats: Splats, index: Tensor, pixels: int, footprints: Footprints | None) -> Splats:
    """Gives each of P pixels centres of its own ``[P, N, 2]`` whose gradients are noted, if that is asked for."""
    if footprints is None or footprints.absgrad is None or not footprints.means2d.requires_grad:
        return splats
    absgrad, center = footprints.absgrad[0], splats.center.expand(pixels, -1, -1)

    def note(grad: Tensor) -> None:
        absgrad[index] += grad.abs().sum(0)

    center.register_hook(note)
    return replace(splats, center=center)


def _render_pixels(splats: Splats, pixels: Tensor, background: Tensor, options: RenderOptions) -> Images:
    """Blends P pixels front to back (paper, eqn 3dgs_render_preliminary; eqn gggs_color with ``G(t*) = alpha``)."""
    response, peak, precision = respond(splats, pixels[:, None])  # [P, N]
    alpha = response.clamp(max=options.alpha_max)
    alpha = torch.where(response.detach() >= ALPHA_MIN, alpha, torch.zeros_like(alpha))
    kept = torch.cumprod(1 - alpha.detach(), -1) >= TRANSMITTANCE_STOP
    alpha = torch.where(kept, alpha, torch.zeros_like(alpha))
    passed = torch.log1p(-alpha)
    after = torch.cumsum(passed, -1)
    before = torch.exp(after - passed)
    weight = alpha * before  # [P, N], paper, eqn 3dgs_render_preliminary
    final = torch.exp(passed.sum(-1))
    color = weight @ splats.color + final[:, None] * background  # [P, 3]
    normal, depth = torch.zeros_like(color), torch.zeros_like(final)
    if options.geometry and len(splats.depth):
        normal = weight @ splats.normal
        depth = ray_depth(alpha, weight, before.detach(), final, peak, precision, options)
    return color, normal, depth, 1 - final
