"""Constants of the renderers: what counts as a hit of a ray, and numbers of the kernels."""

from typing import Any

import numpy as np

ALPHA_MIN = 1.0 / 255.0  # a Gaussian weaker than this at a pixel is no hit (3DGS)
TRANSMITTANCE_STOP = 1e-4  # the hit that would bring transmittance below this is dropped with all behind it (3DGS)
MEDIAN_MAX_TRANSMITTANCE = 0.45  # a solid ray whose final transmittance is larger has no median depth
BRACKET_SIGMAS = 4.0  # the median lies within this many standard deviations of the hits' peaks
JACOBIAN_CLAMP = 1.3  # half fields of view at which 3DGS clamps the projection's Jacobian (rasterized only)

# exact in float32, so that they do not change the type they meet
ZERO, HALF, ONE, TWO, FOUR, QUARTER = (np.float32(value) for value in (0, 0.5, 1, 2, 4, 0.25))
BIG = np.float32(2.0**100)
FAST: Any = {"contract", "nsz", "arcp"}  # nothing that reorders sums or assumes finite values
SUMS: Any = {"contract", "nsz", "arcp", "reassoc"}
