"""What the compiled tile kernels share: sizes of a tile's memory, and how its rays and Gaussians are laid out in it."""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

from vg2gt.kernels.compiled import kernel_part
from vg2gt.kernels.compiled_math import exp
from vg2gt.kernels.constants import FAST, ONE, ZERO

TILE = 16
SIDE = 4  # a block of SIDE x SIDE rays is one vector operation
BLOCKS_ACROSS = TILE // SIDE
BLOCKS = BLOCKS_ACROSS**2
LANES = SIDE**2
COLUMN, ROW_BITS = np.int32(SIDE - 1), np.int32(SIDE.bit_length() - 1)  # a lane's: lane & COLUMN, lane >> ROW_BITS
PLANE = TILE * TILE
PLANES = 17  # of PLANE values: the state of a tile
SUMS_ROWS = 18  # of LANES values: the sums of one Gaussian
HIT_SIZE = 3 * LANES  # one hit of a block's rays: alpha, peak, precision
STAGED = 16  # Gaussians copied at a time, with their colours
RECORD = 16  # projected Gaussian: centre 2, conic 3, tilt 2, z, a0, eps, opacity, cutoff, normal 3, unused
ROW = 16  # gradient of one (tile, Gaussian): centre 2, conic 3, tilt 2, z, a0, opacity, colour 3, normal 3


@intrinsic
def any_positive(typing_context, values, first):
    """Whether one of a block's values is positive: one comparison, where the compiler would go through them singly."""

    def codegen(context, builder, signature, args):
        array, item = signature.args[0], context.get_data_type(signature.args[0].dtype)
        begin = builder.gep(make_array(array)(context, builder, args[0]).data, [args[1]])
        lanes = builder.bitcast(begin, ir.VectorType(item, LANES).as_pointer())
        loaded = builder.load(lanes, align=context.get_abi_alignment(item))
        positive = builder.fcmp_ordered(">", loaded, ir.Constant(loaded.type, [0.0] * LANES))
        bits = ir.IntType(LANES)
        return builder.icmp_unsigned("!=", builder.bitcast(positive, bits), bits(0))

    return types.boolean(values, first), codegen


@kernel_part(fastmath=FAST, error_model="numpy")
def alive_blocks(state):
    """The blocks of which a ray still meets Gaussians, a bit each."""
    alive = 0
    for block in range(BLOCKS):
        alive |= np.int64(any_positive(state, np.uintp(block * LANES))) << block  # pyright: ignore[reportCallIssue]
    return alive


@kernel_part(fastmath=FAST, error_model="numpy")
def _touched(first, last):
    """Blocks that pixels ``first .. last - 1`` of a tile's row or column touch, the part beyond the tile left out."""
    return max(first, 0) // SIDE, (min(last, TILE) + SIDE - 1) // SIDE


@kernel_part(fastmath=FAST, error_model="numpy")
def place_of(y, x):
    """Where the ray of a tile's pixel lies in a plane: blocks one after the other, rows of a block likewise."""
    return np.uintp((y // SIDE * BLOCKS_ACROSS + x // SIDE) * LANES + y % SIDE * SIDE + x % SIDE)


@kernel_part(fastmath=FAST, error_model="numpy")
def stage(records, colors, boxes, members, x_tile, y_tile, staged, spans):
    """Copies a tile's next Gaussians side by side, so that cache misses overlap: record, colour, blocks touched."""
    for j in range(len(members)):
        i = np.uintp(members[j])
        for k in range(RECORD):
            staged[j, k] = records[i, k]
        for k in range(3):
            staged[j, RECORD + k] = colors[i, k]
        spans[j, 0], spans[j, 1] = _touched(boxes[i, 0] - x_tile, boxes[i, 1] - x_tile)
        spans[j, 2], spans[j, 3] = _touched(boxes[i, 2] - y_tile, boxes[i, 3] - y_tile)


@kernel_part(fastmath=FAST, error_model="numpy")
def start_rays(state, columns, rows):
    """Transmittance 1 in the image's pixels, stopped rays beyond its border."""
    for y in range(TILE):
        for x in range(TILE):
            state[place_of(y, x)] = ONE if (y < rows and x < columns) else -ONE


@kernel_part(fastmath=FAST, error_model="numpy", forceinline=True)
def respond(dx, before, g, s_row, e_row, f_row):
    """A Gaussian's response along a ray (rendering/projection.py): E, 1 + s, r, and whether it counts."""
    qa, q0, eps, cutoff = g
    e = (qa * dx + f_row) * dx + e_row
    s = q0 * dx + s_row
    r = s * s + eps * e
    return e, s, r, (e <= cutoff * r) & (s > ZERO) & (before > ZERO)


@kernel_part(fastmath=FAST, error_model="numpy", forceinline=True)
def attenuate(exponent, on, before, opacity, alpha_max, stop):
    """Opacity at the pixel, 0 where the hit does not count or stops the ray; transmittance behind; its next state."""
    full = min(opacity * exp(exponent), alpha_max)
    full = full if on else ZERO
    after = before * (ONE - full)
    stopped = on & (after < stop)
    return ZERO if stopped else full, after, -before if stopped else after
