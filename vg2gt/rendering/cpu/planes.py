"""Offsets into a tile's flat scratch arrays: constants, so that the compiler knows that planes do not overlap."""

import numpy as np

from vg2gt.rendering.cpu.tiles import LANES, PLANE, SUMS_ROWS

# state: plane 0 is the transmittance, negative once a ray has stopped; forward and backward use the same memory
C0, C1, C2, N0, N1, N2, MEDIAN, MEAN, HI, LO, THIN, NUM, DEN, LAST, MOVING, SOUGHT = (
    np.uintp(j * PLANE) for j in range(1, 17)
)
REST, G0, G1, G2, G3, G4, G5, DEPTH, KD, GE, GM = (np.uintp(j * PLANE) for j in range(1, 12))
# sums of one Gaussian's gradients over a tile's blocks
AX, AY, AXX, AXY, AYY, B, BX, BY, GR, GO, K0, K1, K2, M0, M1, M2, GZ, GP, ABS_X, ABS_Y = (
    np.uintp(j * LANES) for j in range(SUMS_ROWS)
)
# one hit of each of a block's rays, and the next
HIT_PEAK, HIT_PRECISION, NEXT_HIT = (np.uintp(j * LANES) for j in (1, 2, 3))
