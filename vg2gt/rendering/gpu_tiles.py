"""Runs the Triton kernels for all views of all scenes at once, as an autograd function.

Forward: project every Gaussian into every view of its scene, count its tiles, read the counts (the only host-device
synchronisation), write one entry per (tile, Gaussian), sort the entries by view, tile and depth, blend the tiles.
Backward: visit the tiles again, write one gradient row per entry, sum and chain the rows of every Gaussian in order.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from vg2gt.rendering.constants import (
    BRACKET_SIGMAS,
    CONVERGED,
    MEDIAN_MAX_TRANSMITTANCE,
    NEGLIGIBLE,
    TRANSMITTANCE_STOP,
)
from vg2gt.rendering.footprints import note_visible
from vg2gt.rendering.gpu import kernels as launchable
from vg2gt.rendering.gpu.binning import ENTRIES
from vg2gt.rendering.gpu.projection import BLOCK, REFUSED, SLOTS
from vg2gt.rendering.gpu.projection_backward import CAMERA
from vg2gt.rendering.gpu.tiles import RECORD, TILE
from vg2gt.rendering.options import RenderOptions
from vg2gt.types import Cameras, Footprints, Gaussians, Render

kernels: Any = launchable  # Triton kernels are launched as kernel[grid](...), which type checkers do not know

_ROW_SHARE = 64  # gradient rows take 1 / _ROW_SHARE of a GPU's memory
ROWS = 3_000_000  # gradient rows held at once without a GPU
_SLOT_SHARE, _SLOT_BYTES = 8, 256  # slots rendered at once take 1 / _SLOT_SHARE; bytes per slot, with its entries


class RefusedError(ValueError):
    """Raised if the kernels meet a value that cannot be rendered; the caller must find out which one."""


def render_triton(
    gaussians: Gaussians,
    cameras: Cameras,
    background: Tensor,
    options: RenderOptions,
    rows: int | None = None,
    footprints: Footprints | None = None,
) -> Render:
    """Renders every view of every scene; differentiable in every floating-point tensor.

    Args:
        gaussians: Gaussians of all scenes, sorted by scene, with checked shapes.
        cameras: views to render.
        background: ``[3]``.
        options: render options.
        rows: maximum number of gradient rows held at once, at least those of one view; None: by the device's memory.
        footprints: of all Gaussians and views, to be filled; None: not asked for.

    Raises:
        RefusedError: if a value is not finite or out of range, or the Gaussians
            cover too many tiles.
        ValueError: if Gaussians times views exceed ``SLOTS``.
    """
    tensors = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    tensors = (*tensors, cameras.world_to_camera, cameras.intrinsics, background)
    with torch.cuda.device_of(gaussians.means):  # Triton launches on the current device
        slots = _at_once(gaussians.means.device, SLOTS, _SLOT_SHARE * _SLOT_BYTES)
        some = max(1, slots // max(1, len(gaussians)))
        parts = []
        for number, (poses, intrinsics) in enumerate(
            zip(tensors[5].split(some, 1), tensors[6].split(some, 1), strict=True)
        ):
            own = footprints and footprints.select(slice(number * some, (number + 1) * some))
            inputs = (*tensors[:5], poses, intrinsics, background, gaussians.batch, own and own.means2d)
            parts.append(_Render.apply(*inputs, cameras.size, options, rows, own and own.detach()))
    joined = parts[0] if len(parts) == 1 else [torch.cat(images, 1) for images in zip(*parts, strict=True)]
    color, normal, depth, alpha = joined
    return Render(color, depth, normal, alpha)


class _Lists(NamedTuple):
    """Tile entries of all views.

    Attributes:
        records: ``[V, G, 16]``, see ``tiles.RECORD``; only those of visible Gaussians are written.
        ends: ``[V * G]`` inclusive prefix sum of the entries per slot.
        members: slot of every sorted entry.
        places: gradient row of every sorted entry: its index before sorting, in the order of slots.
        starts: first sorted entry of every tile of every view, and the end.
        chunks: views whose gradient rows are held at once: first view, number of views, first entry, end.
    """

    records: Tensor
    ends: Tensor
    members: Tensor
    places: Tensor
    starts: Tensor
    chunks: tuple[tuple[int, int, int, int], ...]


class _Render(torch.autograd.Function):
    """Forward and backward of all views."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Returns colour and normals ``[B, V, 3, H, W]``, depth and accumulated opacity ``[B, V, H, W]``."""
        tensors = tuple(tensor.contiguous() for tensor in inputs[:9])
        (height, width), options, rows, footprints = inputs[10:]
        poses, background = tensors[5], tensors[7]
        scenes, views = poses.shape[:2]
        rows = rows or _at_once(poses.device, ROWS, _ROW_SHARE * 4 * RECORD)
        lists = _list(tensors, (height, width), options, rows)
        solid = options.mode == "solid"
        if footprints is not None:
            _note(lists, footprints, solid)
        across, tiles = _tiles(height, width)
        make = torch.empty if options.geometry else torch.zeros
        shape, like = (scenes, views, height, width), {"dtype": poses.dtype, "device": poses.device}
        color = torch.empty((scenes, views, 3, height, width), **like)
        normal, depth = make((scenes, views, 3, height, width), **like), make(shape, **like)
        alpha, transmittance, slopes = (torch.empty(shape, **like) for _ in range(3))
        kernels.blend_kernel[(scenes * views * tiles,)](
            lists.records, lists.members, lists.starts, background, color, normal, depth, alpha, transmittance, slopes,
            height, width, across, tiles,
            near=options.near, alpha_max=options.alpha_max, stop=TRANSMITTANCE_STOP,
            negligible=NEGLIGIBLE[poses.element_size()], median_max=MEDIAN_MAX_TRANSMITTANCE, sigmas=BRACKET_SIGMAS,
            steps=options.search_steps, newton=options.newton_steps > 0,
            converged=CONVERGED * torch.finfo(poses.dtype).eps,
            solid=solid, geometry=options.geometry, mean=options.depth == "expected", num_warps=1,
        )  # fmt: skip
        ctx.save_for_backward(*tensors, *lists[:5], color, normal, depth, transmittance, slopes)
        ctx.chunks, ctx.size, ctx.options, ctx.footprints = lists.chunks, (height, width), options, footprints
        ctx.set_materialize_grads(False)
        return color, normal, depth, alpha

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor | None) -> tuple[Tensor | None, ...]:
        """Returns gradients of Gaussians, cameras and background."""
        saved = ctx.saved_tensors
        means, quats, scales, opacities, sh, poses, intrinsics, _, batch = saved[:9]
        lists = _Lists(*saved[9:14], chunks=ctx.chunks)
        images = saved[14:]
        color, _, depth, transmittance, _ = images
        options: RenderOptions = ctx.options
        solid, geometry = options.mode == "solid", options.geometry and any(g is not None for g in grad_outputs[1:3])
        incoming = [
            torch.zeros_like(image) if grad is None else grad.contiguous()
            for grad, image in zip(grad_outputs, (color, images[1], depth, depth), strict=True)
        ]
        scenes, views = poses.shape[:2]
        height, width = ctx.size
        across, tiles = _tiles(height, width)
        total = len(means)
        blocks = -(-total // BLOCK)
        grads = [torch.zeros_like(tensor) for tensor in (means, quats, scales, opacities, sh)]
        of_cameras = ctx.needs_input_grad[5] or ctx.needs_input_grad[6]
        grad_cameras = poses.new_zeros(blocks if of_cameras else 1, scenes * views, CAMERA)
        degree = _degree(sh)
        footprints: Footprints | None = ctx.footprints
        grad_means2d = None if footprints is None else torch.zeros_like(footprints.means2d)
        absolute = footprints is not None and footprints.absgrad is not None
        for first, some, begin, end in lists.chunks:
            if begin == end:
                continue
            rows = means.new_zeros(end - begin, RECORD)
            sums = rows.new_zeros(end - begin, 2) if absolute else rows  # which the kernel then leaves alone
            kernels.backward_kernel[(scenes * some * tiles,)](
                lists.records, lists.members, lists.places, lists.starts, *images, *incoming, rows, sums,
                height, width, across, tiles, views, first, some, begin,
                alpha_max=options.alpha_max, stop=TRANSMITTANCE_STOP, slope_floor=options.slope_floor,
                tiny=torch.finfo(means.dtype).tiny,
                solid=solid, geometry=geometry, mean=options.depth == "expected", absolute=absolute, num_warps=1,
            )  # fmt: skip
            if footprints is not None and grad_means2d is not None:
                of_views = slice(first, first + some)
                grad_means2d[of_views] = _per_gaussian(rows[:, :2], lists, total, of_views)
                if footprints.absgrad is not None:
                    footprints.absgrad[of_views] += _per_gaussian(sums, lists, total, of_views)
            kernels.project_backward_kernel[(blocks,)](
                means, quats, scales, opacities, sh, batch, poses, intrinsics, lists.records, lists.ends, rows,
                *grads, grad_cameras, total, views, scenes, height, width, first, some, begin,
                lowpass=options.lowpass, solid=solid, antialiased=options.antialiased, degree=degree,
                cameras=of_cameras, num_warps=BLOCK // 32,
            )  # fmt: skip
            del rows  # frees them before the next chunk's are allocated
        grad_poses = grad_intrinsics = grad_background = None
        if of_cameras:
            summed = grad_cameras.sum(0)
            grad_poses = summed[:, :16].view(poses.shape)
            grad_intrinsics = summed[:, 16:].view(intrinsics.shape)
        if ctx.needs_input_grad[7]:
            grad_background = (incoming[0] * transmittance[:, :, None]).sum((0, 1, 3, 4))
        return (*grads, grad_poses, grad_intrinsics, grad_background, None, grad_means2d, None, None, None, None)


def _note(lists: _Lists, footprints: Footprints, solid: bool) -> None:
    """Notes the visible Gaussians of all views."""
    slots = _counts(lists.ends).nonzero()[:, 0]
    r, total = lists.records.view(-1, RECORD)[slots], max(1, footprints.radii.shape[1])
    curvature = 1 / (r[:, 7] ** 2 * r[:, 8]) if solid else torch.zeros_like(r[:, 7])
    note_visible(footprints, slots // total, slots % total, r[:, :2], r[:, 2:5], r[:, 5:7], curvature, r[:, 9])


def _per_gaussian(rows: Tensor, lists: _Lists, total: int, views: slice) -> Tensor:
    """Returns the sums ``[views, G, 2]`` of the rows ``[entries, 2]`` of some views, in order."""
    counts = _counts(lists.ends)[views.start * total : views.stop * total]
    summed = torch.segment_reduce(rows.contiguous(), "sum", lengths=counts, unsafe=True)
    return summed.view(-1, total, 2)


def _counts(ends: Tensor) -> Tensor:
    return torch.diff(ends, prepend=ends.new_zeros(1))


def _tiles(height: int, width: int) -> tuple[int, int]:
    """Returns tiles per image row and tiles per view."""
    across = -(-width // TILE)
    return across, across * -(-height // TILE)


def _degree(sh: Tensor) -> int:
    return round(sh.shape[1] ** 0.5) - 1


def _at_once(device: torch.device, otherwise: int, each: int) -> int:
    """Returns how many things of ``each`` bytes a GPU holds; by total memory, as free memory would vary results."""
    return torch.cuda.get_device_properties(device).total_memory // each if device.type == "cuda" else otherwise


def _list(tensors: tuple[Tensor, ...], size: tuple[int, int], options: RenderOptions, rows: int) -> _Lists:
    """Projects all Gaussians and builds the sorted tile lists."""
    means, quats, scales, opacities, sh, poses, intrinsics, background, batch = tensors
    (scenes, views), (height, width), total = poses.shape[:2], size, len(means)
    across, tiles = _tiles(height, width)
    if total * views > SLOTS:
        raise ValueError(f"{total} Gaussians in {views} views are too many to render at once; render fewer views")
    records = means.new_empty(views, total, RECORD)
    rects = batch.new_empty(views, total, 2, dtype=torch.int32)
    ends = batch.new_empty(views * total)
    per_view = [0] * views
    if total:
        kernels.project_kernel[(-(-total // BLOCK), views)](
            means, quats, scales, opacities, sh, batch, poses, intrinsics, background, records, rects, ends,
            total, views, scenes, height, width, across,
            near=options.near, lowpass=options.lowpass, solid=options.mode == "solid", antialiased=options.antialiased,
            degree=_degree(sh), num_warps=BLOCK // 32,
        )  # fmt: skip
        ends = torch.cumsum(ends, 0)
        per_view = ends[total - 1 :: total].tolist()  # the only host-device synchronisation
    entries = per_view[-1]
    if entries >= REFUSED:
        raise RefusedError(
            f"the Gaussians, cameras or background contain invalid values, or {total} Gaussians cover more than "
            f"{REFUSED} tiles in {views} views; render fewer views at once"
        )
    keys, owners = batch.new_empty(entries), batch.new_empty(entries, dtype=torch.int32)
    if entries:
        kernels.emit_kernel[(-(-entries // ENTRIES),)](
            records, rects, ends, batch, keys, owners,
            total, views, tiles, across, entries, (views * total).bit_length(), num_warps=4,
        )  # fmt: skip
        keys, order = torch.sort(keys, stable=True)
    else:
        order = keys
    members, places = torch.empty_like(owners), torch.empty_like(owners)
    starts = batch.new_empty(scenes * views * tiles + 1, dtype=torch.int32)
    kernels.list_kernel[(-(-max(entries, len(starts)) // ENTRIES),)](
        keys, order, owners, members, places, starts, entries, scenes * views * tiles, entries.bit_length(),
        num_warps=4,
    )  # fmt: skip
    return _Lists(records, ends, members, places, starts, _chunks(per_view, rows))


def _chunks(ends: list[int], rows: int) -> tuple[tuple[int, int, int, int], ...]:
    """Splits views into chunks of at most ``rows`` entries or one view: (first view, views, first entry, end)."""
    chunks: list[tuple[int, int, int, int]] = []
    first, begin = 0, 0
    for view in range(1, len(ends) + 1):
        if view == len(ends) or ends[view] - begin > rows:
            chunks.append((first, view - first, begin, ends[view - 1]))
            first, begin = view, ends[view - 1]
    return tuple(chunks)
