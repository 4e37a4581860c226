"""Hilbert codes of cells in one Triton kernel; plain torch needs about 400 launches."""

# pyright: reportGeneralTypeIssues=false, reportOperatorIssue=false, reportIndexIssue=false
# (Triton's type hints do not cover the operators and ranges used inside kernels)

from __future__ import annotations

from typing import Any

import torch
import triton  # pyright: ignore[reportMissingImports]
import triton.language as tl  # pyright: ignore[reportMissingImports]
from torch import Tensor

CELLS = 256  # cells per program

_CELLS = tl.constexpr(CELLS)


@triton.jit(do_not_specialize=("count", "bits"))
def _hilbert_kernel(grid, codes, count, bits):
    """:func:`vg2gt.kernels.curve_codes.hilbert_reference`, one lane per cell."""
    m = tl.program_id(0).to(tl.int64) * _CELLS + tl.arange(0, _CELLS)
    there = m < count
    x = tl.load(grid + 3 * m, mask=there, other=0)
    y = tl.load(grid + 3 * m + 1, mask=there, other=0)
    z = tl.load(grid + 3 * m + 2, mask=there, other=0)
    one = x * 0 + 1
    level = bits - 1
    while level > 0:
        below = (one << level) - 1
        x = tl.where((x >> level & 1) > 0, x ^ below, x)
        inverted, swapped = (y >> level & 1) > 0, (x ^ y) & below
        x, y = tl.where(inverted, x ^ below, x ^ swapped), tl.where(inverted, y, y ^ swapped)
        inverted, swapped = (z >> level & 1) > 0, (x ^ z) & below
        x, z = tl.where(inverted, x ^ below, x ^ swapped), tl.where(inverted, z, z ^ swapped)
        level -= 1
    y = y ^ x
    z = z ^ y
    flip, code = x * 0, x * 0
    level = bits - 1
    while level > 0:
        flip ^= tl.where((z >> level & 1) > 0, (one << level) - 1, 0)
        level -= 1
    x, y, z = x ^ flip, y ^ flip, z ^ flip
    level = bits - 1
    while level >= 0:
        code = code << 3 | (x >> level & 1) << 2 | (y >> level & 1) << 1 | (z >> level & 1)
        level -= 1
    tl.store(codes + m, code, mask=there)


def hilbert_in_one_kernel(grid: Tensor, bits: int) -> Tensor:
    """Codes ``[M]`` of cells ``[M, 3]`` on a GPU; see :func:`vg2gt.kernels.curve_codes.hilbert_codes`."""
    grid = grid.contiguous()
    codes = grid.new_empty(len(grid))
    if len(grid):
        with torch.cuda.device_of(grid):
            kernel: Any = _hilbert_kernel  # Triton kernels are launched as kernel[grid](...)
            kernel[(-(-len(grid) // CELLS),)](grid, codes, len(grid), bits, num_warps=4)
    return codes
