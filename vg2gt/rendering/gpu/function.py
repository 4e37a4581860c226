"""Projects, bins and drives the Triton kernels for all views of a scene at once, and joins them to autograd.

Deterministic: tiles write pixels and gradient rows of their own; a splat's rows adjoin and are summed in order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from vg2gt.rendering.gpu import kernels as launchable
from vg2gt.rendering.median import depth_factors
from vg2gt.rendering.options import (
    ALPHA_MIN,
    BRACKET_SIGMAS,
    MEDIAN_MAX_TRANSMITTANCE,
    TRANSMITTANCE_STOP,
    Images,
    RenderOptions,
    SceneViews,
)
from vg2gt.rendering.projection import Splats, list_cells, pixel_boxes, visible_splats

kernels: Any = launchable  # Triton makes its functions objects that take a grid: kernel[grid](...)

HIT_CAPACITY = 48  # hits that a ray keeps for the depth solver before the views are blended again with more room
NEGLIGIBLE = {torch.float32: 30.0, torch.float64: 90.0}  # squared sigmas at which a profile vanishes


def rasterize_triton(scene: SceneViews, options: RenderOptions) -> Images:
    """Renders every view; differentiable in every tensor of the scene."""
    views = [visible_splats(scene.view(index), options) for index in range(len(scene.world_to_camera))]
    counts = torch.tensor([len(box) for _, box in views], device=scene.means.device)
    records = torch.cat([_pack(splats) for splats, _ in views])
    lists = _bin(torch.cat([box for _, box in views]), counts, scene.size)
    color, normal, depth, alpha = _Rasterize.apply(records, scene.background, lists, options)
    return Images(color, normal, depth, alpha)


@dataclass(frozen=True)
class _Lists:
    """Tile lists of all views.

    Attributes:
        members: splat of every list entry.
        places: the entry's gradient row; a splat's rows adjoin.
        starts: first entry of every tile of every view, and the end.
        areas: tiles of every splat.
        across: tiles in an image row.
        tiles: tiles of a view.
        shape: views, height, width.
    """

    members: Tensor
    places: Tensor
    starts: Tensor
    areas: Tensor
    across: int
    tiles: int
    shape: tuple[int, int, int]


def _pack(splats: Splats) -> Tensor:
    """Records ``[N, 18]`` in the kernels' order."""
    cutoff = 2 * torch.log(splats.opacity.detach() / ALPHA_MIN)
    scalars = (splats.depth, splats.precision, splats.curvature, splats.opacity, cutoff)
    return torch.cat(
        (splats.center, splats.conic, splats.tilt, torch.stack(scalars, -1), splats.normal, splats.color), -1
    )


def _bin(box: Tensor, counts: Tensor, size: tuple[int, int]) -> _Lists:
    """Lists splats by tile, front to back; splats are given view by view, front to back, with their screen boxes."""
    height, width = size
    across, down = -(-width // kernels.TILE), -(-height // kernels.TILE)
    low, high = pixel_boxes(box, size)
    first, last = low // kernels.TILE, high // kernels.TILE
    extent = torch.where((high < low).any(-1)[:, None], 0, last - first + 1)
    splat, cells = list_cells(first, extent)
    view = torch.repeat_interleave(counts)[splat]
    tile = cells[:, 1] * across + cells[:, 0] + view * across * down
    tile, order = torch.sort(tile, stable=True)
    edges = torch.arange(len(counts) * across * down + 1, device=box.device)
    starts = torch.searchsorted(tile, edges)
    shape = (len(counts), height, width)
    return _Lists(splat[order].int(), order.int(), starts.int(), extent.prod(-1), across, across * down, shape)


class _Rasterize(torch.autograd.Function):
    """Forward and backward of all views; differentiable in the records and the background."""

    @staticmethod
    def forward(
        ctx: Any, records: Tensor, background: Tensor, lists: _Lists, options: RenderOptions
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        views, height, width = lists.shape
        pixels = views * height * width
        solid = options.mode == "solid"

        def image(*channels: int) -> Tensor:
            return records.new_zeros(*lists.shape, *channels)

        color, normal, transmittance, depth, slope = image(3), image(3), image(), image(), image()
        mean, median, high = image(), image(), image()
        counts = torch.zeros(lists.shape, dtype=torch.int32, device=records.device)
        grid, capacity = (views * lists.tiles,), HIT_CAPACITY if solid and options.geometry else 1
        while True:
            hits = records.new_empty(3, capacity, pixels)
            kernels.blend_kernel[grid](
                records, lists.members, lists.starts, background, color, normal, transmittance, mean, median, high,
                counts, hits, height, width, lists.across, lists.tiles, pixels, capacity, capacity * pixels,
                options.alpha_max, TRANSMITTANCE_STOP, NEGLIGIBLE[records.dtype], options.geometry, solid, num_warps=1,
            )  # fmt: skip
            most = int(counts.max()) if counts.numel() else 0
            if most <= capacity:
                break
            capacity = most
        if options.geometry and solid:
            kernels.solve_kernel[grid](
                hits, counts, high, transmittance, depth, slope, height, width, lists.across, lists.tiles, pixels,
                capacity * pixels, options.near, MEDIAN_MAX_TRANSMITTANCE, BRACKET_SIGMAS, options.bisections,
                options.newton_steps, num_warps=1,
            )  # fmt: skip
        elif options.geometry:
            covered = 1 - transmittance
            expected = torch.where(covered > 0, mean / covered, 0.0)
            depth = expected if options.depth == "expected" else median
        ctx.save_for_backward(records, color, normal, depth, slope, transmittance)
        ctx.lists, ctx.options = lists, options
        ctx.set_materialize_grads(False)
        return color, normal, depth, 1 - transmittance

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor | None) -> tuple[Tensor | None, ...]:
        records, color, normal, depth, slope, transmittance = ctx.saved_tensors
        lists: _Lists = ctx.lists
        options: RenderOptions = ctx.options
        like = (color, normal, depth, depth)
        geometry = options.geometry and (grad_outputs[1] is not None or grad_outputs[2] is not None)
        grad_color, grad_normal, grad_depth, grad_alpha = (
            torch.zeros_like(image) if grad is None else grad.contiguous()
            for grad, image in zip(grad_outputs, like, strict=True)
        )
        grad_solid, grad_expected, grad_crossing, grad_alpha = depth_factors(
            grad_depth, grad_alpha, depth, slope, transmittance, options
        )
        rows = records.new_zeros(len(lists.members), kernels.RECORD)
        views, height, width = lists.shape
        kernels.backward_kernel[(views * lists.tiles,)](
            records, lists.members, lists.places, lists.starts, color, normal, depth, transmittance,
            grad_color, grad_normal, grad_alpha, grad_solid, grad_expected, grad_crossing, rows,
            height, width, lists.across, lists.tiles, options.alpha_max, TRANSMITTANCE_STOP, geometry, num_warps=1,
        )  # fmt: skip
        grad_records = torch.segment_reduce(rows, "sum", lengths=lists.areas) if len(records) else records * 0
        grad_background = (grad_color * transmittance[..., None]).sum((0, 1, 2))
        return grad_records, grad_background, None, None
