"""A Gaussian's response along a ray, once for the compiled forward and backward pass; and the exponential it needs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic, overload

from vg2gt.rendering.cpu.constants import FAST, HALF, ONE, ZERO

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


@njit(fastmath=FAST, error_model="numpy", inline="always")
def respond(dx, before, g, s_row, e_row, f_row):
    """A Gaussian's response along a ray (rendering/projection.py): E, 1 + s, r, and whether it counts.

    ``g`` holds what the formula needs of the Gaussian: Q_xx, q_x, eps, cutoff; the rest depends on the row alone.
    """
    qa, q0, eps, cutoff = g
    e = (qa * dx + f_row) * dx + e_row
    s = q0 * dx + s_row
    r = s * s + eps * e
    return e, s, r, (e <= cutoff * r) & (s > ZERO) & (before > ZERO)


@njit(fastmath=FAST, error_model="numpy", inline="always")
def attenuate(exponent, on, before, opacity, alpha_max, stop):
    """Opacity at the pixel, 0 where the hit does not count or stops the ray; transmittance behind; its next state."""
    full = min(opacity * exp(exponent), alpha_max)
    full = full if on else ZERO
    after = before * (ONE - full)
    stopped = on & (after < stop)
    return ZERO if stopped else full, after, -before if stopped else after
