"""Math functions shared by the compiled kernels of several packages; they vectorise where the standard ones do not."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic, overload

HALF, ONE, ZERO = (np.float32(value) for value in (0.5, 1, 0))
_LOG2E = np.float32(1.4426950408889634)
_LN2_HIGH, _LN2_LOW = np.float32(0.693359375), np.float32(-2.12194440e-4)
_EXP2_BIAS, _EXP2_SHIFT = np.int32(127), np.int32(23)
LEAST = np.float32(-40)  # smallest exponent: products with e^-87 are denormal, a hundred times slower on Intel CPUs
_E6, _E5, _E4, _E3, _E2 = (np.float32(1 / math.factorial(n)) for n in (6, 5, 4, 3, 2))


@intrinsic
def _float32_of_bits(typing_context, bits):
    def codegen(context, builder, signature, args):
        return builder.bitcast(args[0], ir.FloatType())

    return types.float32(types.int32), codegen


def exp(x: Any) -> Any:
    """Returns ``e^x`` for x <= 0; in float32 it vectorises (relative error 2e-7) and is at least e^-40."""
    raise NotImplementedError("compiled code only")


@overload(exp, jit_options={"fastmath": {"contract", "nsz", "arcp", "nnan"}, "error_model": "numpy"})
def _exp_overload(x):
    if x == types.float64:
        return lambda x: math.exp(x)

    def exp32(x):
        x = max(x, LEAST)
        n = np.floor(x * _LOG2E + HALF)
        f = x - n * _LN2_HIGH
        f = f - n * _LN2_LOW
        p = ((((_E6 * f + _E5) * f + _E4) * f + _E3) * f + _E2) * f * f + f + ONE
        return p * _float32_of_bits((np.int32(n) + _EXP2_BIAS) << _EXP2_SHIFT)  # pyright: ignore[reportCallIssue]

    return exp32


# 1 - Phi(z) = t p(t) exp(-z^2 / 2) for z >= 0, t = 1 / (1 + _TAIL z). The coefficients minimise the maximum error of
# gelu and of its derivative: 8e-9 before rounding to float32.
_TAIL = np.float32(0.28)
_T1, _T2, _T3, _T4, _T5, _T6 = (
    np.float32(value) for value in (0.11683751, 0.06554693, 0.27367689, -0.24277995, 0.39336311, -0.10664452)
)
_BELL = np.float32(1 / math.sqrt(2 * math.pi))


@njit(fastmath={"contract", "nsz", "arcp"}, error_model="numpy", inline="always")
def gelu(x):
    """Returns ``x Phi(x)`` of a float32 and its derivative ``Phi(x) + x phi(x)``, absolute error 4e-7; NaN for NaN."""
    t = ONE / (ONE + _TAIL * np.abs(x))
    bell = exp(-HALF * x * x)
    above = ((((((_T6 * t + _T5) * t + _T4) * t + _T3) * t + _T2) * t + _T1) * t) * bell
    below = above if x < ZERO else ONE - above
    return x * below, below + x * bell * _BELL
