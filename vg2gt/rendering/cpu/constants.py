"""Constants of the compiled kernels: exact in float32, so that they do not change the type they meet."""

from typing import Any

import numpy as np

ZERO, HALF, ONE, TWO, FOUR, QUARTER = (np.float32(value) for value in (0, 0.5, 1, 2, 4, 0.25))
BIG = np.float32(2.0**100)
FAST: Any = {"contract", "nsz", "arcp"}  # nothing that reorders sums or assumes finite values
SUMS: Any = {"contract", "nsz", "arcp", "reassoc"}
