"""Gaussians as the page's script reads them."""

from __future__ import annotations

import gzip
import math
from dataclasses import replace

import numpy as np

from vg2gt.io.gaussian_arrays import to_arrays
from vg2gt.types import Gaussians

UNSIGNED, SIGNED = 2**16 - 1, 2**15 - 1  # largest values stored in 16 bits


def without_zeros(gaussians: Gaussians) -> Gaussians:
    """Leaves the highest SH degrees out if they are all zero."""
    sh = gaussians.sh
    while sh.shape[1] > 1 and not sh[:, (math.isqrt(sh.shape[1]) - 1) ** 2 :].any():
        sh = sh[:, : (math.isqrt(sh.shape[1]) - 1) ** 2]
    return replace(gaussians, sh=sh)


def pack(gaussians: Gaussians) -> tuple[dict[str, float], bytes]:
    """Encodes one scene for the page's script.

    Returns:
        Header for the script, and the columns, little endian and gzip-compressed: float32 means, float16 SH
        coefficients, 16-bit logarithms of the standard deviations between the scene's smallest and largest, 16-bit
        components of unit quaternions, 16-bit opacities.

    Raises:
        ValueError: if there is more than one scene, or a value that is not finite or out of range.
    """
    arrays = to_arrays(gaussians)
    length = np.linalg.norm(arrays.quats, axis=-1, keepdims=True)
    sh, half_max = arrays.sh, float(np.finfo(np.float16).max)
    logs = np.log(arrays.scales)
    low, high = float(logs.min()), float(logs.max())
    columns = (
        arrays.means.astype("<f4"),
        sh.clip(-half_max, half_max).astype("<f2"),
        np.rint((logs - low) / max(high - low, 1e-12) * UNSIGNED).astype("<u2"),
        np.rint(arrays.quats / length * SIGNED).astype("<i2"),
        np.rint(arrays.opacities * UNSIGNED).astype("<u2"),
    )
    content = gzip.compress(b"".join(column.tobytes() for column in columns), compresslevel=6, mtime=0)
    degree = math.isqrt(sh.shape[1]) - 1
    return {"count": len(sh), "degree": degree, "log_scale_min": low, "log_scale_max": high}, content
