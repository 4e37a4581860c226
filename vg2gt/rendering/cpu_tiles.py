"""Runs the compiled kernels over views and work items, as an autograd function.

Bitwise deterministic for any number of threads: all sums have a fixed order.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vg2gt.kernels.threads import parallel_for
from vg2gt.rendering.constants import CONVERGED, MEDIAN_MAX_TRANSMITTANCE, NEGLIGIBLE, TRANSMITTANCE_STOP
from vg2gt.rendering.cpu import tiles
from vg2gt.rendering.cpu.backward import BACKWARD
from vg2gt.rendering.cpu.forward import forward_color, forward_rasterized, forward_solid
from vg2gt.rendering.cpu.projection import BLOCK, project_block
from vg2gt.rendering.cpu.projection_backward import CHUNK, FIELDS, project_backward_block
from vg2gt.rendering.cpu.tiles import count_tiles, depth_order, fill_tiles
from vg2gt.rendering.footprints import note_visible
from vg2gt.rendering.median import depth_factors
from vg2gt.rendering.options import RenderOptions
from vg2gt.rendering.scenes import Images, SceneViews
from vg2gt.types import Footprints

_TILES_PER_ITEM = 8
HIT_CAPACITY = 128  # hits per ray for the depth solver, even; a tile with more gets a larger buffer
_CACHE_LINE = 64  # bytes

_local = threading.local()


def rasterize_cpu(scene: SceneViews, options: RenderOptions) -> Images:
    """Renders every view; differentiable in every tensor of the scene."""
    means2d, into = (scene.footprints.means2d, scene.footprints.detach()) if scene.footprints else (None, None)
    return _Rasterize.apply(*scene.tensors, means2d, scene.size, options, into)  # pyright: ignore[reportReturnType]


@dataclass(frozen=True)
class _Lists:
    """One view's projected Gaussians and tile lists (numpy; names as in the kernels)."""

    records: np.ndarray
    boxes: np.ndarray
    counts: np.ndarray
    offsets: np.ndarray
    starts: np.ndarray
    members: np.ndarray
    places: np.ndarray
    visits: np.ndarray  # of every entry: bit mask of the blocks that it changes, written by the forward pass


@dataclass(frozen=True)
class _View:
    """Inputs of one view (numpy)."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray
    pose: np.ndarray
    intrinsics: np.ndarray
    background: np.ndarray
    size: tuple[int, int]

    @property
    def across(self) -> int:  # tiles per image row
        return -(-self.size[1] // tiles.TILE)

    @property
    def tiles(self) -> int:  # per image
        return self.across * -(-self.size[0] // tiles.TILE)

    @property
    def tile_ranges(self) -> list[tuple[int, int]]:  # first and last tile (exclusive) of every work item
        starts = range(0, self.tiles, _TILES_PER_ITEM)
        return [(start, min(start + _TILES_PER_ITEM, self.tiles)) for start in starts]

    @property
    def blocks(self) -> range:  # of Gaussians
        return range(-(-len(self.means) // BLOCK))


class _Rasterize(torch.autograd.Function):
    """Forward and backward of all views of a scene."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Images:
        """Returns colour and normals ``[V, H, W, 3]``, depth and accumulated opacity ``[V, H, W]``."""
        tensors, (size, options, footprints) = inputs[:8], inputs[9:]
        arrays = [_array(tensor) for tensor in tensors]
        count, (height, width), dtype = len(arrays[5]), size, arrays[0].dtype
        color = np.empty((count, height, width, 3), dtype)
        normal, depth = np.zeros_like(color), np.zeros((count, height, width), dtype)
        slope, transmittance = np.zeros_like(depth), np.empty_like(depth)
        lists: list[_Lists] = []
        for index in range(count):
            view = _select(arrays, index, size)
            lists.append(_prepare(view, options))
            if footprints is not None:
                _note(lists[-1], footprints, index)
            outputs = (array[index] for array in (color, normal, depth, slope, transmittance))
            _forward(view, lists[-1], options, *outputs)
        images = [torch.from_numpy(array) for array in (color, normal, depth, 1 - transmittance)]
        ctx.save_for_backward(*tensors, *images, torch.from_numpy(slope), torch.from_numpy(transmittance))
        ctx.lists, ctx.size, ctx.options, ctx.footprints = lists, size, options, footprints
        ctx.set_materialize_grads(False)
        return images[0], images[1], images[2], images[3]

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor | None) -> tuple[Tensor | None, ...]:
        """Returns gradients of Gaussians, cameras and background; the median depth is differentiated implicitly."""
        color, normal, depth, _, slope, transmittance = ctx.saved_tensors[8:]
        options: RenderOptions = ctx.options
        geometry = options.geometry and (grad_outputs[1] is not None or grad_outputs[2] is not None)
        grad_color, grad_normal, grad_depth, grad_alpha = (
            torch.zeros_like(image) if grad is None else grad
            for grad, image in zip(grad_outputs, (color, normal, depth, depth), strict=True)
        )
        factors = depth_factors(grad_depth, grad_alpha, depth, slope, transmittance, options)
        solid, expected, crossing, grad_alpha = factors
        images = [_array(image) for image in (color, normal, depth, transmittance)]
        incoming = [_array(grad) for grad in (grad_color, grad_normal, grad_alpha, solid, expected, crossing)]
        arrays = [_array(tensor) for tensor in ctx.saved_tensors[:8]]
        grads = [np.zeros_like(array) for array in arrays]
        footprints: Footprints | None = ctx.footprints
        grad_means2d = None if footprints is None else torch.zeros_like(footprints.means2d)
        width = tiles.ABSOLUTE_ROW if footprints is not None and footprints.absgrad is not None else tiles.ROW
        for index, lists in enumerate(ctx.lists):
            view = _select(arrays, index, ctx.size)
            rows = _aligned(len(lists.members) * width, view.means.dtype).reshape(-1, width)
            planes = [array[index] for array in (*images, *incoming)]
            _backward(view, lists, options, geometry, planes, rows, grads, index)
            if footprints is not None and grad_means2d is not None:
                _note_gradients(lists, rows, grad_means2d[index], footprints.select(slice(index, index + 1)))
        if ctx.needs_input_grad[7]:
            grads[7] = np.einsum("vhwc,vhw->c", incoming[0], images[3])
        result = [
            torch.from_numpy(grad) if needed else None
            for grad, needed in zip(grads, ctx.needs_input_grad[:8], strict=True)
        ]
        return (*result, grad_means2d, None, None, None)


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


def _select(arrays: list[np.ndarray], index: int, size: tuple[int, int]) -> _View:
    means, quats, scales, opacities, colors, poses, intrinsics, background = arrays
    color = colors[index % len(colors)]
    return _View(means, quats, scales, opacities, color, poses[index], intrinsics[index], background, size)


def _prepare(view: _View, options: RenderOptions) -> _Lists:
    """Projects one view's Gaussians, orders them by depth and lists them by tile."""
    total, dtype = len(view.means), view.means.dtype
    records = np.empty((total, tiles.RECORD), dtype)
    boxes = np.empty((total, 4), np.int32)
    height, width = view.size
    solid = options.mode == "solid"

    def project(block: int) -> None:
        project_block(
            block, view.means, view.quats, view.scales, view.opacities, view.pose, view.intrinsics, height, width,
            options.lowpass, options.near, solid, options.antialiased, records, boxes,
        )  # fmt: skip

    parallel_for(view.blocks, project)
    visible = np.flatnonzero(boxes[:, 1] > boxes[:, 0]).astype(np.int32)
    visible = visible[depth_order(records[visible, 7])]
    counts, offsets = np.empty(total, np.int32), np.empty(total, np.int64)
    starts = np.empty(view.tiles + 1, np.int64)
    count_tiles(boxes, view.across, counts, offsets, starts)
    members, places = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.int64)
    fill_tiles(boxes, visible, view.across, offsets, starts[:-1].copy(), members, places)
    return _Lists(records, boxes, counts, offsets, starts, members, places, np.zeros(len(members), np.uint16))


def _note(lists: _Lists, footprints: Footprints, index: int) -> None:
    """Notes the visible Gaussians of one view."""
    seen = np.flatnonzero(lists.counts)
    r = torch.from_numpy(lists.records[seen])
    note_visible(footprints, index, torch.from_numpy(seen), r[:, :2], r[:, 2:5], r[:, 5:7], r[:, 9], r[:, 11])


def _note_gradients(lists: _Lists, rows: np.ndarray, grad: Tensor, footprints: Footprints) -> None:
    """Writes the gradient of one view's positions ``[G, 2]``, and adds the absolute one if asked for."""
    seen = np.flatnonzero(lists.counts)
    columns = np.concatenate((rows[:, :2], rows[:, tiles.ROW :]), 1, dtype=np.float64)
    sums = torch.from_numpy(np.add.reduceat(columns, lists.offsets[seen])).to(grad.dtype)
    grad[seen] = sums[:, :2]
    if footprints.absgrad is not None:
        footprints.absgrad[0, seen] += sums[:, 2:]


def _parameters(options: RenderOptions, dtype: np.dtype) -> np.ndarray:
    values = (
        options.alpha_max, TRANSMITTANCE_STOP, MEDIAN_MAX_TRANSMITTANCE, options.near, NEGLIGIBLE[dtype.itemsize],
        CONVERGED * np.finfo(dtype).eps,
    )  # fmt: skip
    return np.array(values, dtype)


def _scratch(dtype: np.dtype) -> SimpleNamespace:
    """Returns this thread's scratch memory (names as in the kernels), kept between calls."""
    buffers = _local.__dict__.setdefault("buffers", {})
    if dtype not in buffers:
        buffers[dtype] = SimpleNamespace(
            state=_aligned(tiles.PLANES * tiles.PLANE, dtype),
            sums=_aligned(tiles.SUMS_ROWS * tiles.LANES, dtype),
            hits=_room_for_hits(HIT_CAPACITY, dtype),
            counts=np.zeros(tiles.PLANE, np.int64),
            staged=np.zeros((tiles.STAGED, tiles.RECORD + 3), dtype),
            touched=np.zeros(tiles.STAGED, np.int64),
            total=np.empty(16, np.float64),
            work=np.ones(FIELDS * CHUNK, np.float64),
            indices=np.empty(CHUNK, np.int64),
        )
    return buffers[dtype]


def _aligned(count: int, dtype: np.dtype) -> np.ndarray:
    """Allocates an array that begins at a cache line, so that no vector operation on a block of rays touches two."""
    memory = np.empty(count * dtype.itemsize + _CACHE_LINE, np.uint8)
    start = -memory.ctypes.data % _CACHE_LINE
    return memory[start : start + count * dtype.itemsize].view(dtype)


def _room_for_hits(each: int, dtype: np.dtype) -> np.ndarray:
    """Allocates room for ``each`` hits of every ray of a tile, and the entry at hand; all finite."""
    hits = _aligned((tiles.BLOCKS * each + 1) * tiles.HIT_SIZE, dtype)
    hits[:] = 0
    return hits


def _forward(view: _View, lists: _Lists, options: RenderOptions, *outputs: np.ndarray) -> None:
    parameters = _parameters(options, view.means.dtype)
    render_tiles = forward_color
    if options.geometry:
        render_tiles = forward_solid if options.mode == "solid" else forward_rasterized

    newton, steps = options.newton_steps > 0, options.search_steps

    def run(tile_range: tuple[int, int]) -> None:
        """Renders a range of tiles with this thread's buffers."""
        scratch = _scratch(view.means.dtype)
        hits, (first, last) = scratch.hits, tile_range
        while first < last:
            first = render_tiles(
                lists.records, lists.boxes, view.colors, lists.members, lists.visits, lists.starts, (first, last),
                options.depth == "expected", steps, newton, parameters, view.background,
                scratch.state, hits, scratch.counts, scratch.staged, scratch.touched, *outputs,
            )  # fmt: skip
            if first < last:
                most = int(scratch.counts.max())
                hits = _room_for_hits(most + most % 2, view.means.dtype)

    parallel_for(view.tile_ranges, run)


def _backward(
    view: _View,
    lists: _Lists,
    options: RenderOptions,
    geometry: bool,
    planes: list[np.ndarray],
    rows: np.ndarray,
    grads: list[np.ndarray],
    index: int,
) -> None:
    """Adds one view's gradients to ``grads`` (order of SceneViews.tensors); ``planes``: images and their gradients."""
    parameters = _parameters(options, view.means.dtype)
    height, width = view.size
    solid = options.mode == "solid"
    visit_tiles = BACKWARD[options.mode if geometry else "color", rows.shape[1] > tiles.ROW]

    def rasterize(tile_range: tuple[int, int]) -> None:
        scratch = _scratch(view.means.dtype)
        visit_tiles(
            lists.records, view.colors, lists.members, lists.visits, lists.places, lists.starts, tile_range, parameters,
            scratch.state, scratch.sums, scratch.staged, *[*planes, rows],
        )  # fmt: skip

    parallel_for(view.tile_ranges, rasterize)
    cameras = np.empty((len(view.blocks), 16), np.float64)
    means, quats, scales, opacities, colors = grads[:5]
    pose = view.pose.astype(np.float64)

    def project(block: int) -> None:
        scratch = _scratch(view.means.dtype)
        project_backward_block(
            block, view.means, view.quats, view.scales, pose, view.intrinsics, height, width,
            options.lowpass, solid, options.antialiased, lists.records, lists.counts, lists.offsets, rows,
            index % len(colors), scratch.total, scratch.work, scratch.indices,
            means, quats, scales, opacities, colors, cameras,
        )  # fmt: skip

    parallel_for(view.blocks, project)
    camera = cameras.sum(0)
    grads[5][index, :3] = camera[:12].reshape(3, 4)
    grads[6][index, [0, 1, 0, 1], [0, 1, 2, 2]] = camera[12:]
