"""SuperSplat's compressed PLY: Gaussians packed into 16 bytes each, in chunks of 256 with bounds of their own.

A chunk's element gives least and largest position, logarithm of the scale and, in newer files, colour. A vertex holds
``packed_position`` and ``packed_scale`` (11, 10 and 11 bits between the chunk's bounds), ``packed_rotation`` (2 bits
name the largest of w x y z, which is left out; 10 bits for each of the others) and ``packed_color`` (8 bits for red,
green, blue and opacity). Higher spherical harmonics are bytes of their own element ``sh``, from -4 to 4.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vg2gt.geometry.spherical_harmonics import DC
from vg2gt.io.errors import FormatError
from vg2gt.io.gaussian_arrays import GaussianArrays

CHUNK = 256
_SH_RANGE = 8.0


def unpacked(path: Path, elements: Mapping[str, NDArray]) -> GaussianArrays:
    """The Gaussians of a file.

    Args:
        path: the file, for messages.
        elements: ``vertex``, ``chunk`` and, if there are higher spherical harmonics, ``sh``.

    Raises:
        FormatError: if a part is missing or does not fit.
    """
    vertex, chunk = elements["vertex"], elements.get("chunk")
    packed = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
    missing = [name for name in packed if name not in (vertex.dtype.names or ())]
    if missing or chunk is None or len(chunk) * CHUNK < len(vertex):
        raise FormatError(
            f"{path}: a compressed PLY of {len(vertex)} vertices lacks {', '.join(missing) or 'chunks'}; it is damaged"
        )
    position, rotation, scale, color = (vertex[name].astype(np.uint32) for name in packed)
    row = np.arange(len(vertex)) // CHUNK

    def between(values: NDArray[np.float64], names: tuple[str, ...], prefix: str = "") -> NDArray[np.float64]:
        least, most = (
            np.stack([_column(path, chunk, f"{end}_{prefix}{name}")[row] for name in names], 1)
            for end in ("min", "max")
        )
        return least + values * (most - least)

    axes = ("x", "y", "z")
    rgba = np.stack([(color >> shift & 255) / 255 for shift in (24, 16, 8, 0)], 1)
    rgb = rgba[:, :3]
    if "min_r" in (chunk.dtype.names or ()):
        rgb = between(rgb, ("r", "g", "b"))
    sh = ((rgb - 0.5) / DC)[:, None]
    if "sh" in elements:
        sh = np.concatenate((sh, _higher(path, elements["sh"], len(vertex))), 1)
    with np.errstate(over="ignore"):  # an infinite result is found and counted
        scales = np.exp(between(_three(scale), axes, "scale_"))
    return GaussianArrays(between(_three(position), axes), _rotations(rotation), scales, rgba[:, 3], sh)


def _column(path: Path, table: NDArray, name: str) -> NDArray[np.float64]:
    if name not in (table.dtype.names or ()):
        raise FormatError(f"{path}: the chunks have no {name}; it is damaged")
    return table[name].astype(np.float64)


def _three(packed: NDArray[np.uint32]) -> NDArray[np.float64]:
    """``[N, 3]`` in [0, 1] of 11, 10 and 11 bits."""
    return np.stack(((packed >> 21) / 2047, (packed >> 11 & 1023) / 1023, (packed & 2047) / 2047), 1)


def _rotations(packed: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Unit quaternions ``[N, 4]`` wxyz."""
    small = np.stack([((packed >> shift & 1023) / 1023 - 0.5) * np.sqrt(2) for shift in (20, 10, 0)], 1)
    largest = np.sqrt(np.maximum(1 - (small**2).sum(1), 0))
    place = (packed >> 30).astype(np.int64)
    quats = np.empty((len(packed), 4))
    for missing in range(4):
        rows = place == missing
        quats[rows] = np.insert(small[rows], missing, largest[rows], 1)
    return quats


def _higher(path: Path, table: NDArray, count: int) -> NDArray[np.float64]:
    """Higher spherical harmonics ``[N, 3, 8 or 15, 3]``: coefficients before colours."""
    names = [name for name in (table.dtype.names or ()) if name.startswith("f_rest_")]
    if len(table) != count or len(names) not in (9, 24, 45):
        raise FormatError(f"{path}: {len(table)} rows of {len(names)} f_rest for {count} vertices; it is damaged")
    values = np.stack([table[f"f_rest_{i}"] for i in range(len(names))], 1).astype(np.float64)
    return (values * (_SH_RANGE / 255) - _SH_RANGE / 2).reshape(count, 3, -1).transpose(0, 2, 1)
