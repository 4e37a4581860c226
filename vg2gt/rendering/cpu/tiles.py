"""What the compiled tile kernels share: layout of a tile's memory, constants, exponential.

The compiler's cache follows the file that defines a kernel only: after a change here, touch forward.py and backward.py.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic, overload

TILE = 16
RECORD = 16  # projected Gaussian: centre 2, conic 3, tilt 2, z, a0, eps, opacity, cutoff, normal 3, unused
ROW = 16  # gradient of one (tile, Gaussian): centre 2, conic 3, tilt 2, z, a0, opacity, colour 3, normal 3
PLANES = 18  # of TILE * TILE values: the state of a tile
STAGED = 16  # Gaussians copied at a time, with their colours
LANE_ROWS = 15  # of TILE values: the sums of one Gaussian
HIT_SIZE = 3 * TILE  # one hit of 16 rays: alpha, peak, precision
HIT, HIT_PEAK, HIT_PRECISION = np.uintp(HIT_SIZE), np.uintp(TILE), np.uintp(2 * TILE)
PARAMETERS = ("alpha_max", "stop", "median_max", "near", "negligible")

ZERO, HALF, ONE, TWO, FOUR, QUARTER = (np.float32(value) for value in (0, 0.5, 1, 2, 4, 0.25))
BIG = np.float32(2.0**100)
FAST: Any = {"contract", "nsz", "arcp"}  # nothing that reorders sums or assumes finite values
SUMS: Any = {"contract", "nsz", "arcp", "reassoc"}
PLANE = TILE * TILE
# planes; forward and backward use the same memory
C0, C1, C2, N0, N1, N2, MEDIAN, MEAN, HI, LO, NUM, DEN, COUNT = (np.uintp(j * PLANE) for j in range(1, 14))
ALPHA, PEAK, PRECISION, SLOT = (np.uintp(j * PLANE) for j in range(14, 18))
REST, G0, G1, G2, G3, G4, G5, DEPTH, KD, GE, GM = (np.uintp(j * PLANE) for j in range(1, 12))
A0, A1, A2, B0, B1, GR, GO, K0, K1, K2, M0, M1, M2, GZ, GP = (np.uintp(j * TILE) for j in range(LANE_ROWS))

LOG2E = np.float32(1.4426950408889634)
LN2_HIGH, LN2_LOW = np.float32(0.693359375), np.float32(-2.12194440e-4)
EXP2_BIAS, EXP2_SHIFT = np.int32(127), np.int32(23)
UNDERFLOW = np.float32(-87.0)
E6, E5, E4, E3, E2 = (np.float32(1 / math.factorial(n)) for n in (6, 5, 4, 3, 2))


@intrinsic
def _float32_of_bits(typing_context, bits):
    def codegen(context, builder, signature, args):
        return builder.bitcast(args[0], ir.FloatType())

    return types.float32(types.int32), codegen


def exp(x: Any) -> Any:
    """Exponential of a number <= 0: vectorising in float32 (relative error 2e-7), the library's in float64."""
    raise NotImplementedError("compiled code only")


@overload(exp, jit_options={"fastmath": {"contract", "nsz", "arcp", "nnan"}, "error_model": "numpy"})
def _exp_overload(x):
    if x == types.float64:
        return lambda x: math.exp(x)

    def exp32(x):
        x = max(x, UNDERFLOW)
        n = np.floor(x * LOG2E + HALF)
        f = x - n * LN2_HIGH
        f = f - n * LN2_LOW
        p = ((((E6 * f + E5) * f + E4) * f + E3) * f + E2) * f * f + f + ONE
        return p * _float32_of_bits((np.int32(n) + EXP2_BIAS) << EXP2_SHIFT)  # pyright: ignore[reportCallIssue]

    return exp32


@njit(fastmath=SUMS, error_model="numpy", nogil=True, cache=True)
def any_alive(state):
    """Whether any ray of the tile still meets Gaussians."""
    most = state[0]
    for k in range(PLANE):
        most = max(most, state[k])
    return most > ZERO


@njit(error_model="numpy", nogil=True, cache=True)
def stage(records, colors, boxes, members, x_tile, y_tile, staged, spans):
    """Copies the next Gaussians of a tile side by side, so that their cache misses overlap.

    ``staged`` receives the record and, from column RECORD on, the colour; ``spans`` the box clipped to the tile, in its
    own pixels: columns first and last, rows first and last (ends excluded).
    """
    for j in range(len(members)):
        i = np.uintp(members[j])
        for k in range(RECORD):
            staged[j, k] = records[i, k]
        for k in range(3):
            staged[j, RECORD + k] = colors[i, k]
        spans[j, 0], spans[j, 1] = max(boxes[i, 0] - x_tile, 0), min(boxes[i, 1] - x_tile, TILE)
        spans[j, 2], spans[j, 3] = max(boxes[i, 2] - y_tile, 0), min(boxes[i, 3] - y_tile, TILE)


@njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def start_rays(state, columns, rows):
    """Transmittance 1 in the image's pixels, stopped rays beyond its border."""
    for y in range(TILE):
        for x in range(TILE):
            state[np.uintp(y * TILE + x)] = ONE if (y < rows and x < columns) else -ONE
