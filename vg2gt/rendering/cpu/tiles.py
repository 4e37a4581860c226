"""Shared parts of the compiled tile kernels: memory layout of a tile, and lists of Gaussians per tile."""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numba.np.arrayobj import make_array
from numpy.typing import NDArray

from vg2gt.kernels.compiled import kernel, kernel_part
from vg2gt.kernels.compiled_math import exp
from vg2gt.rendering.constants import FAST, ONE, ZERO

_TILE_BITS = 4  # tiles are 16 pixels wide and high
TILE = 1 << _TILE_BITS
SIDE = 4  # a block of SIDE x SIDE rays is one vector operation
BLOCKS_ACROSS = TILE // SIDE
BLOCKS = BLOCKS_ACROSS**2
LANES = SIDE**2
LANE_X, LANE_Y = (offset.ravel().astype(np.float32) for offset in np.meshgrid(np.arange(SIDE), np.arange(SIDE)))
PLANE = TILE * TILE
PLANES = 17  # planes of a tile's state
SUMS_ROWS = 20  # gradient sums of one Gaussian, LANES values each
HIT_SIZE = 3 * LANES  # one hit of each of a block's rays: alpha, peak, precision
_FIRST_COLUMN = sum(1 << row * BLOCKS_ACROSS for row in range(BLOCKS_ACROSS))  # bit mask of blocks
STAGED = 16  # Gaussians copied at a time, with their colours
RECORD = 16  # projected Gaussian: centre 2, conic 3, tilt 2, z, a0, eps, opacity, cutoff, normal 3, unused
ROW = 16  # gradient of one (tile, Gaussian): centre 2, conic 3, tilt 2, z, a0, opacity, colour 3, normal 3
ABSOLUTE_ROW = ROW + 2  # the same, and sums over pixels of absolute gradients of the centre


@intrinsic
def positive_lanes(typing_context, values, first):
    """Bit mask of a block's positive values, in one vector comparison; the compiler would use a scalar loop."""

    def codegen(context, builder, signature, args):
        array, item = signature.args[0], context.get_data_type(signature.args[0].dtype)
        begin = builder.gep(make_array(array)(context, builder, args[0]).data, [args[1]])
        lanes = builder.bitcast(begin, ir.VectorType(item, LANES).as_pointer())
        loaded = builder.load(lanes, align=context.get_abi_alignment(item))
        positive = builder.fcmp_ordered(">", loaded, ir.Constant(loaded.type, [0.0] * LANES))
        return builder.zext(builder.bitcast(positive, ir.IntType(LANES)), ir.IntType(64))

    return types.int64(values, first), codegen


@intrinsic
def select(typing_context, condition, first, second):
    """``first if condition else second`` without a branch, which could become a masked store: slow on many CPUs."""
    kind = typing_context.unify_types(first, second)

    def codegen(context, builder, signature, args):
        values = (
            context.cast(builder, value, given, kind) for value, given in zip(args[1:], signature.args[1:], strict=True)
        )
        return builder.select(args[0], *values)

    return kind(types.boolean, first, second), codegen


@intrinsic
def lowest_bit(typing_context, bits):
    """Index of the lowest bit that is set."""

    def codegen(context, builder, signature, args):
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return bits(bits), codegen


@kernel_part(fastmath=FAST, error_model="numpy")
def alive_blocks(state):
    """Returns a bit mask of the blocks in which a ray has not stopped."""
    alive = 0
    for block in range(BLOCKS):
        lanes = positive_lanes(state, np.uintp(block * LANES))  # pyright: ignore[reportCallIssue]
        alive |= np.int64(lanes != 0) << block
    return alive


@kernel_part(fastmath=FAST, error_model="numpy")
def _touched(first, last):
    """Returns the range of blocks that pixels ``first .. last - 1`` along one axis touch, clipped to the tile."""
    return np.int64(max(first, 0) // SIDE), np.int64((min(last, TILE) + SIDE - 1) // SIDE)


@kernel_part(fastmath=FAST, error_model="numpy")
def place_of(y, x):
    """Returns the index in a plane of a pixel's ray: block by block, row by row within a block."""
    return np.uintp((y // SIDE * BLOCKS_ACROSS + x // SIDE) * LANES + y % SIDE * SIDE + x % SIDE)


@kernel_part(fastmath=FAST, error_model="numpy")
def stage(records, colors, members, staged):
    """Copies record and colour of a tile's next Gaussians, so that cache misses overlap."""
    for j in range(len(members)):
        i = np.uintp(members[j])
        for k in range(RECORD):
            staged[j, k] = records[i, k]
        for k in range(3):
            staged[j, RECORD + k] = colors[i, k]


@kernel_part(fastmath=FAST, error_model="numpy")
def find_blocks(boxes, members, x_tile, y_tile, touched):
    """Writes bit masks of the blocks of a tile that the boxes of its next Gaussians touch."""
    for j in range(len(members)):
        i = np.uintp(members[j])
        x0, x1 = _touched(boxes[i, 0] - x_tile, boxes[i, 1] - x_tile)
        y0, y1 = _touched(boxes[i, 2] - y_tile, boxes[i, 3] - y_tile)
        lines = _FIRST_COLUMN & ((1 << y1 * BLOCKS_ACROSS) - (1 << y0 * BLOCKS_ACROSS))
        touched[j] = lines * ((1 << x1) - (1 << x0))


@kernel_part(fastmath=FAST, error_model="numpy")
def start_rays(state, columns, rows):
    """Sets transmittance 1 inside the image; rays beyond its border start as stopped."""
    for y in range(TILE):
        for x in range(TILE):
            state[place_of(y, x)] = ONE if (y < rows and x < columns) else -ONE


@kernel_part(fastmath=FAST, error_model="numpy", forceinline=True)
def respond(dx, g, s_row, e_row, f_row):
    """Returns a Gaussian's response along a ray (rendering/projection.py): E, 1 + s, r, and whether it is a hit."""
    qa, q0, eps, cutoff = g
    e = (qa * dx + f_row) * dx + e_row
    s = q0 * dx + s_row
    r = s * s + eps * e
    return e, s, r, (e <= cutoff * r) & (s > ZERO)


@kernel_part(fastmath=FAST, error_model="numpy", forceinline=True)
def attenuate(exponent, on, before, opacity, alpha_max, stop):
    """Returns alpha (0 for no hit, a stopped ray, or a hit that stops it), transmittance behind it, and the next state.

    A ray that has stopped needs no test: it has a negative transmittance, and so it stops again.
    """
    full = min(opacity * exp(exponent), alpha_max)
    full = select(on, full, ZERO)  # pyright: ignore[reportCallIssue]
    after = before * (ONE - full)
    stopped = after < stop
    state = select(stopped, -abs(before), after)  # pyright: ignore[reportCallIssue]
    return select(stopped, ZERO, full), after, state  # pyright: ignore[reportCallIssue]


def depth_order(depths: NDArray) -> NDArray:
    """Returns the stable front-to-back order ``[N]`` of positive depths."""
    if depths.dtype != np.float32:
        return np.argsort(depths, kind="stable")
    # Bits of positive floats sort like the floats. With the index in the low bits all keys differ: any sort is stable.
    keys = depths.view(np.uint32).astype(np.uint64) << np.uint64(32)
    keys |= np.arange(len(keys), dtype=np.uint64)
    keys.sort()
    return keys.astype(np.uint32)


@kernel(error_model="numpy", nogil=True)
def count_tiles(boxes, across, counts, offsets, starts):
    """Counts tiles per Gaussian (and prefix sums in ``offsets``) and Gaussians per tile (prefix sums in ``starts``)."""
    for k in range(len(starts)):
        starts[k] = 0
    total = 0
    for i in range(len(boxes)):
        counts[i], offsets[i] = 0, total
        if boxes[i, 1] <= boxes[i, 0]:
            continue
        x0, x1 = boxes[i, 0] >> _TILE_BITS, (boxes[i, 1] - 1) >> _TILE_BITS
        y0, y1 = boxes[i, 2] >> _TILE_BITS, (boxes[i, 3] - 1) >> _TILE_BITS
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                starts[y * across + x + 1] += 1
        counts[i] = (x1 - x0 + 1) * (y1 - y0 + 1)
        total += counts[i]
    for k in range(len(starts) - 1):
        starts[k + 1] += starts[k]


@kernel(error_model="numpy", nogil=True)
def fill_tiles(boxes, visible, across, offsets, ends, members, places):
    """Writes the tile lists, front to back, and the gradient row of each entry; ``ends`` begin as a copy of starts."""
    for i in visible:
        place = offsets[i]
        x0, x1 = boxes[i, 0] >> _TILE_BITS, (boxes[i, 1] - 1) >> _TILE_BITS
        y0, y1 = boxes[i, 2] >> _TILE_BITS, (boxes[i, 3] - 1) >> _TILE_BITS
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                position = ends[y * across + x]
                members[position], places[position] = i, place
                ends[y * across + x] = position + 1
                place += 1
