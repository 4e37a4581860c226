"""Gaussians as the compact bytes inside a viewer page, and back.

One block per column, little endian, in the order of ``_columns``: float32 means, float16 colour coefficients, 16-bit
logarithms of the standard deviations between the scene's smallest and largest, 16-bit components of unit quaternions,
16-bit opacities. 34 bytes per Gaussian with colours of degree 0, 124 of degree 3, before gzip.
"""

from __future__ import annotations

import gzip
import math
from dataclasses import asdict, dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from vg2gt.io.gaussian_arrays import to_arrays
from vg2gt.types import Gaussians

_UNSIGNED, _SIGNED = 2**16 - 1, 2**15 - 1
_HALF_MAX = float(np.finfo(np.float16).max)


@dataclass(frozen=True)
class PackedGaussians:
    """What a page needs to know to read its Gaussians.

    Attributes:
        count: G.
        degree: of the spherical harmonics, 0 to 3.
        log_scale_min: natural logarithm of the smallest standard deviation.
        log_scale_max: of the largest.
        content: the columns, compressed by gzip.
    """

    count: int
    degree: int
    log_scale_min: float
    log_scale_max: float
    content: bytes

    def header(self) -> dict[str, float]:
        """Everything but the content."""
        fields = asdict(self)
        del fields["content"]
        return fields


def pack(gaussians: Gaussians) -> PackedGaussians:
    """Packs one scene; bands of colour that are zero throughout are left out.

    Raises:
        ValueError: if there is no Gaussian, more than one scene, or a value that is not finite or out of range.
    """
    if not len(gaussians):
        raise ValueError("there are no Gaussians to show")
    arrays = to_arrays(gaussians)
    if np.abs(arrays.means).max() > np.finfo(np.float32).max:
        raise ValueError("means must fit into float32")
    length = np.linalg.norm(arrays.quats, axis=-1, keepdims=True)
    if (length == 0).any():
        raise ValueError("quats must not be zero: a rotation has no direction then")
    sh = arrays.sh
    while sh.shape[1] > 1 and not sh[:, (math.isqrt(sh.shape[1]) - 1) ** 2 :].any():
        sh = sh[:, : (math.isqrt(sh.shape[1]) - 1) ** 2]
    logs = np.log(arrays.scales)
    low, high = float(logs.min()), float(logs.max())
    columns = (
        arrays.means.astype("<f4"),
        sh.clip(-_HALF_MAX, _HALF_MAX).astype("<f2"),
        np.rint((logs - low) / max(high - low, 1e-12) * _UNSIGNED).astype("<u2"),
        np.rint(arrays.quats / length * _SIGNED).astype("<i2"),
        np.rint(arrays.opacities * _UNSIGNED).astype("<u2"),
    )
    content = gzip.compress(b"".join(column.tobytes() for column in columns), compresslevel=6, mtime=0)
    return PackedGaussians(len(sh), math.isqrt(sh.shape[1]) - 1, low, high, content)


def unpack(packed: PackedGaussians) -> Gaussians:
    """The Gaussians of packed bytes, as the page reads them: scene 0, float32."""
    count, coefficients = packed.count, (packed.degree + 1) ** 2
    data, at = gzip.decompress(packed.content), 0

    def take(kind: str, *shape: int) -> NDArray[np.float64]:
        nonlocal at
        column = np.frombuffer(data, kind, math.prod(shape), at)
        at += column.nbytes
        return column.reshape(shape).astype(np.float64)

    means, sh = take("<f4", count, 3), take("<f2", count, coefficients, 3)
    span = packed.log_scale_max - packed.log_scale_min
    scales = np.exp(take("<u2", count, 3) / _UNSIGNED * span + packed.log_scale_min)
    quats, opacities = take("<i2", count, 4) / _SIGNED, take("<u2", count) / _UNSIGNED
    means, quats, scales, opacities, sh = (
        torch.from_numpy(column).float() for column in (means, quats, scales, opacities, sh)
    )
    return Gaussians(means, quats, scales, opacities, sh, torch.zeros(count, dtype=torch.int64))
