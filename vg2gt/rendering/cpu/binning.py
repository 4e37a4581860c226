"""Compiled binning: depth order and the tiles' lists of Gaussians for one view."""

from __future__ import annotations

import numpy as np
from numba import njit

DIGIT_BITS = 11


@njit(error_model="numpy", nogil=True, cache=True)
def radix_order(keys, bits):
    """Stable ascending order ``[N]`` of unsigned integers with the given number of bits."""
    order = np.arange(len(keys)).astype(np.int32)
    spare = np.empty_like(order)
    counts = np.empty(1 << DIGIT_BITS, np.int64)
    mask = np.uint64((1 << DIGIT_BITS) - 1)
    for shift in range(0, bits, DIGIT_BITS):
        counts[:] = 0
        for i in range(len(keys)):
            counts[(np.uint64(keys[i]) >> np.uint64(shift)) & mask] += 1
        total = 0
        for digit in range(len(counts)):
            count = counts[digit]
            counts[digit] = total
            total += count
        for position in range(len(keys)):
            i = order[position]
            digit = (np.uint64(keys[i]) >> np.uint64(shift)) & mask
            spare[counts[digit]] = i
            counts[digit] += 1
        order, spare = spare, order
    return order


@njit(error_model="numpy", nogil=True, cache=True)
def count_tiles(boxes, visible, tile, across, counts, offsets, starts):
    """Counts tiles a Gaussian (with offsets, in the given depth order) and Gaussians a tile (as list starts)."""
    starts[:] = 0
    total = 0
    for i in visible:
        x0, x1 = boxes[i, 0] // tile, (boxes[i, 1] - 1) // tile
        y0, y1 = boxes[i, 2] // tile, (boxes[i, 3] - 1) // tile
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                starts[y * across + x + 1] += 1
        counts[i] = (x1 - x0 + 1) * (y1 - y0 + 1)
        offsets[i] = total
        total += counts[i]
    for k in range(len(starts) - 1):
        starts[k + 1] += starts[k]


@njit(error_model="numpy", nogil=True, cache=True)
def fill_tiles(boxes, visible, tile, across, offsets, starts, members, slots):
    """Writes the tiles' lists, front to back: Gaussian, and slot of its gradient row (a Gaussian's slots adjoin)."""
    ends = starts[:-1].copy()
    for i in visible:
        slot = offsets[i]
        for y in range(boxes[i, 2] // tile, (boxes[i, 3] - 1) // tile + 1):
            for x in range(boxes[i, 0] // tile, (boxes[i, 1] - 1) // tile + 1):
                position = ends[y * across + x]
                members[position] = i
                slots[position] = slot
                ends[y * across + x] = position + 1
                slot += 1
