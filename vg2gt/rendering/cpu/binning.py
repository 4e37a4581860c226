"""Compiled binning: depth order and the tiles' lists of Gaussians for one view."""

from __future__ import annotations

import numpy as np

from vg2gt.io.compiled import kernel

DIGIT_BITS = 11
DIGITS = 1 << DIGIT_BITS
TILE_BITS = 4  # tiles are 16 pixels wide and high


@kernel(error_model="numpy", nogil=True)
def radix_order(keys, bits, order, spare, counts):
    """Stable ascending order ``[N]`` of unsigned integers with the given number of bits.

    ``order`` and ``spare`` ``[N]`` are overwritten and one of them is returned; so is ``counts`` ``[DIGITS]``.
    """
    for i in range(len(keys)):
        order[i] = i
    mask = np.uint64(DIGITS - 1)
    for shift in range(0, bits, DIGIT_BITS):
        for digit in range(len(counts)):
            counts[digit] = 0
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


@kernel(error_model="numpy", nogil=True)
def count_tiles(boxes, across, counts, offsets, starts):
    """Counts tiles per Gaussian (as offsets in their order) and Gaussians per tile (as list starts)."""
    for k in range(len(starts)):
        starts[k] = 0
    total = 0
    for i in range(len(boxes)):
        counts[i], offsets[i] = 0, total
        if boxes[i, 1] <= boxes[i, 0]:
            continue
        x0, x1 = boxes[i, 0] >> TILE_BITS, (boxes[i, 1] - 1) >> TILE_BITS
        y0, y1 = boxes[i, 2] >> TILE_BITS, (boxes[i, 3] - 1) >> TILE_BITS
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                starts[y * across + x + 1] += 1
        counts[i] = (x1 - x0 + 1) * (y1 - y0 + 1)
        total += counts[i]
    for k in range(len(starts) - 1):
        starts[k + 1] += starts[k]


@kernel(error_model="numpy", nogil=True)
def fill_tiles(boxes, visible, across, offsets, ends, members, places):
    """Writes the tiles' lists, front to back, and the place of each entry among its Gaussian's, from its offset on.

    ``ends`` holds the lists' starts, and afterwards their ends.
    """
    for i in visible:
        place = offsets[i]
        x0, x1 = boxes[i, 0] >> TILE_BITS, (boxes[i, 1] - 1) >> TILE_BITS
        y0, y1 = boxes[i, 2] >> TILE_BITS, (boxes[i, 3] - 1) >> TILE_BITS
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                position = ends[y * across + x]
                members[position], places[position] = i, place
                ends[y * across + x] = position + 1
                place += 1
