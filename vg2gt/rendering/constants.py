"""Constants of the renderers: thresholds for hits of a ray, and literals of the kernels."""

from typing import Any

import numpy as np

ALPHA_MIN = 1.0 / 255.0  # a Gaussian with a smaller alpha at a pixel is not a hit (3DGS)
TRANSMITTANCE_STOP = 1e-4  # a hit that would bring transmittance below this is dropped, with all hits behind it (3DGS)
MEDIAN_MAX_TRANSMITTANCE = 0.45  # solid rays with at least this final transmittance have no median depth
BRACKET_SIGMAS = 4.0  # the median lies within this many standard deviations of the hits' peaks
NEGLIGIBLE = {4: 30.0, 8: 90.0}  # by bytes of a number: squared sigmas beyond which a profile is 0
CONVERGED = 4  # relative change of the median, in machine epsilons, at which its search stops
# Lower bound of the squared compensation of an antialiased Gaussian, below ALPHA_MIN ** 2: one that reaches it (a flat
# one seen edge-on) is too faint to be a hit. So it keeps numbers finite, and changes neither images nor gradients.
COMPENSATION_FLOOR = 1e-5
JACOBIAN_CLAMP = 1.3  # 3DGS clamps the projection's Jacobian at this many half fields of view (rasterized only)

# exact in float32, so that results keep the dtype of the other operand
ZERO, HALF, ONE, TWO, FOUR, QUARTER = (np.float32(value) for value in (0, 0.5, 1, 2, 4, 0.25))
BIG = np.float32(2.0**100)
FAST: Any = {"contract", "nsz", "arcp"}  # no flags that reorder sums or assume finite values
SUMS: Any = {"contract", "nsz", "arcp", "reassoc"}
