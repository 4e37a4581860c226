"""What the compiled tile kernels share: sizes of a tile's memory, and how its rays and Gaussians are laid out in it."""

from __future__ import annotations

import numpy as np

from vg2gt.io.compiled import kernel
from vg2gt.rendering.cpu.constants import FAST, ONE, SUMS, ZERO

TILE = 16
PLANE = TILE * TILE
PLANES = 18  # of PLANE values: the state of a tile
LANE_ROWS = 15  # of TILE values: the sums of one Gaussian
HIT_SIZE = 3 * TILE  # one hit of 16 rays: alpha, peak, precision
STAGED = 16  # Gaussians copied at a time, with their colours
RECORD = 16  # projected Gaussian: centre 2, conic 3, tilt 2, z, a0, eps, opacity, cutoff, normal 3, unused
ROW = 16  # gradient of one (tile, Gaussian): centre 2, conic 3, tilt 2, z, a0, opacity, colour 3, normal 3


@kernel(fastmath=SUMS, error_model="numpy", nogil=True)
def any_alive(state):
    """Whether any ray of the tile still meets Gaussians."""
    most = state[0]
    for k in range(PLANE):
        most = max(most, state[k])
    return most > ZERO


@kernel(error_model="numpy", nogil=True)
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


@kernel(fastmath=FAST, error_model="numpy", nogil=True)
def start_rays(state, columns, rows):
    """Transmittance 1 in the image's pixels, stopped rays beyond its border."""
    for y in range(TILE):
        for x in range(TILE):
            state[np.uintp(y * TILE + x)] = ONE if (y < rows and x < columns) else -ONE
