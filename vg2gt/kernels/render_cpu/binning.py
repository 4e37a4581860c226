"""Binning: depth order and, compiled, the tiles' lists of Gaussians for one view."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vg2gt.kernels.compiled import kernel

TILE_BITS = 4  # tiles are 16 pixels wide and high


def depth_order(depths: NDArray) -> NDArray:
    """Order ``[N]`` of positive depths, front to back, equal ones as they came."""
    if depths.dtype != np.float32:
        return np.argsort(depths, kind="stable")
    # Bits of positive numbers ascend as they do; with the place below them all keys differ, and any sort is stable.
    keys = depths.view(np.uint32).astype(np.uint64) << np.uint64(32)
    keys |= np.arange(len(keys), dtype=np.uint64)
    keys.sort()
    return keys.astype(np.uint32)


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
    """Writes the tiles' lists, front to back, and entries' places among their Gaussian's; ``ends`` begin at starts."""
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
