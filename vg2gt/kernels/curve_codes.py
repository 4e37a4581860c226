"""Codes of cells on space-filling curves: Morton in torch; Hilbert in torch, numba (CPUs) and Triton (CUDA devices)."""

from __future__ import annotations

import importlib.util

import torch
from torch import Tensor

from vg2gt.kernels.compiled import kernel


def z_codes(grid: Tensor) -> Tensor:
    """Morton codes ``[...]`` of cells ``[..., 3]``, 0 <= coordinate < 2^21; x holds the highest bit of each triple."""
    # moves bit i of all three axes to bit 3 i, by doubling the gaps between halves
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        grid = (grid | grid << shift) & mask
    x, y, z = grid.unbind(-1)
    return x << 2 | y << 1 | z


def hilbert_codes(grid: Tensor, bits: int) -> Tensor:
    """Hilbert codes of cells (J. Skilling, "Programming the Hilbert curve", 2004); compiled on CPUs and CUDA devices.

    Args:
        grid: ``[M, 3]`` int64 with 0 <= coordinate < 2^bits.
        bits: bits per axis, 1 to 21.

    Returns:
        ``[M]`` int64 < 2^(3 bits); dropping the last three bits gives the code of the parent cell.
    """
    if has_kernel(grid.device):
        from vg2gt.kernels.hilbert import hilbert_in_one_kernel

        return hilbert_in_one_kernel(grid, bits)
    if grid.device.type == "cpu":
        axes = torch.empty_like(grid)
        _hilbert_axes(grid.numpy(), bits, axes.numpy())
        return z_codes(axes)
    return hilbert_reference(grid, bits)


@kernel(nogil=True)
def _hilbert_axes(grid, bits, axes):
    """:func:`hilbert_reference`, one cell after the other, up to the Morton codes."""
    for m in range(len(grid)):
        x, y, z = grid[m, 0], grid[m, 1], grid[m, 2]
        for level in range(bits - 1, 0, -1):
            below = (1 << level) - 1
            if x >> level & 1:
                x ^= below
            if y >> level & 1:
                x ^= below
            else:
                swapped = (x ^ y) & below
                x, y = x ^ swapped, y ^ swapped
            if z >> level & 1:
                x ^= below
            else:
                swapped = (x ^ z) & below
                x, z = x ^ swapped, z ^ swapped
        y ^= x
        z ^= y
        flip = 0
        for level in range(bits - 1, 0, -1):
            flip ^= ((1 << level) - 1) * (z >> level & 1)
        axes[m, 0], axes[m, 1], axes[m, 2] = x ^ flip, y ^ flip, z ^ flip


def has_kernel(device: torch.device) -> bool:
    """Whether a Triton kernel computes Hilbert codes on this device."""
    return device.type == "cuda" and importlib.util.find_spec("triton") is not None


def hilbert_reference(grid: Tensor, bits: int) -> Tensor:
    """:func:`hilbert_codes` in plain torch, all cells at once."""
    axes = list(grid.unbind(-1))
    for level in range(bits - 1, 0, -1):
        below = (1 << level) - 1
        for i in range(3):
            is_set = (axes[i] >> level & 1).bool()
            swapped = (axes[0] ^ axes[i]) & below
            # A set bit inverts the lower bits of x; a clear one exchanges them with those of axis i.
            axes[0] = axes[0] ^ torch.where(is_set, below, swapped)
            if i:
                axes[i] = axes[i] ^ torch.where(is_set, 0, swapped)
    # Gray-encode across the axes, then along the bits.
    axes[1] = axes[1] ^ axes[0]
    axes[2] = axes[2] ^ axes[1]
    flip = torch.zeros_like(axes[0])
    for level in range(bits - 1, 0, -1):
        flip = flip ^ torch.where((axes[2] >> level & 1).bool(), (1 << level) - 1, 0)
    return z_codes(torch.stack([axis ^ flip for axis in axes], -1))
