"""SuperSplat's compressed PLY: 16 bytes per Gaussian, in chunks of 256 with separate bounds.

The element ``chunk`` holds minimum and maximum of position, log-scale and, in newer files, colour. A vertex holds
``packed_position`` and ``packed_scale`` (11, 10 and 11 bits between the chunk's bounds), ``packed_rotation`` (2 bits
for the index of the largest of w x y z, which is left out; 10 bits for each of the others) and ``packed_color`` (8 bits
each for red, green, blue and opacity). Higher spherical harmonics are bytes in a separate element ``sh``, from -4 to 4.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vg2gt.geometry.spherical_harmonics import DC
from vg2gt.io.errors import FormatError
from vg2gt.io.files import write_bytes
from vg2gt.io.gaussian_arrays import GaussianArrays, from_smallest_three, smallest_three, spatial_order, to_arrays
from vg2gt.io.ply_container import ply_content
from vg2gt.types import Gaussians

CHUNK = 256
_SH_RANGE = 8.0
_LOG_SCALE = 20.0  # viewers clamp log-scales to this
_PARTS = {"": "xyz", "scale_": "xyz", "color": "rgb"}


def write_compressed_ply(path: str | Path, gaussians: Gaussians) -> Path:
    """Writes one scene's Gaussians in spatial order, atomically.

    Precision: about 1/2000 of a chunk's extent for positions, 1/1000 of its range for log-scales, 1/255 of its range
    for colours, 1/255 for opacities, 1/700 for rotations, and 1/60 for higher spherical harmonics, which are clipped to
    [-4, 4].

    Args:
        path: output file, by convention ``NAME.compressed.ply``.
        gaussians: one scene; not changed.

    Raises:
        ValueError: if there is more than one scene or a value cannot be written.
    """
    arrays = to_arrays(gaussians)
    order = spatial_order(arrays.means)
    starts = np.arange(0, len(order), CHUNK)
    log_scales = np.log(arrays.scales).clip(-_LOG_SCALE, _LOG_SCALE)
    bounds: dict[str, NDArray[np.float32]] = {}
    shares = []
    for (prefix, axes), values in zip(
        _PARTS.items(), (arrays.means, log_scales, arrays.sh[:, 0] * DC + 0.5), strict=True
    ):
        values = values[order]
        ends = [part.reduceat(values, starts).astype("<f4") for part in (np.minimum, np.maximum)]
        prefix = prefix if axes == "xyz" else ""
        for which, end in zip(("min", "max"), ends, strict=True):
            bounds |= {f"{which}_{prefix}{axis}": column for axis, column in zip(axes, end.T, strict=True)}
        least, most = (np.repeat(end.astype(np.float64), CHUNK, 0)[: len(order)] for end in ends)
        shares.append(((values - least) / np.where(most > least, most - least, 1)).clip(0, 1))
    place, others = smallest_three(arrays.quats[order])
    columns = {
        "packed_position": _pack(shares[0], (11, 10, 11)),
        "packed_rotation": place.astype(np.uint32) << np.uint32(30) | _pack(others / np.sqrt(2) + 0.5, (10, 10, 10)),
        "packed_scale": _pack(shares[1], (11, 10, 11)),
        "packed_color": _pack(np.concatenate((shares[2], arrays.opacities[order, None]), 1), (8, 8, 8, 8)),
    }
    elements = {"chunk": _table(bounds, "<f4"), "vertex": _table(columns, "<u4")}
    if arrays.sh.shape[1] > 1:
        coefficients = arrays.sh.shape[1] - 1
        rest = arrays.sh[order, 1:].transpose(0, 2, 1).reshape(len(order), 3 * coefficients)
        steps = np.floor((rest / _SH_RANGE + 0.5) * 256).clip(0, 255)
        elements["sh"] = _table({f"f_rest_{i}": column for i, column in enumerate(steps.T)}, "u1")
    return write_bytes(path, ply_content(elements))


def _table(columns: Mapping[str, NDArray], kind: str) -> NDArray:
    return np.stack(list(columns.values()), 1).astype(kind).view([(name, kind) for name in columns])[:, 0]


def _pack(shares: NDArray[np.floating], bits: tuple[int, ...]) -> NDArray[np.uint32]:
    """Packs columns in [0, 1] into words, with the given bits each, the first column highest."""
    word = np.zeros(len(shares), np.uint32)
    for column, count in zip(shares.T, bits, strict=True):
        word = word << np.uint32(count) | np.rint(column * ((1 << count) - 1)).astype(np.uint32)
    return word


def unpacked(path: Path, elements: Mapping[str, NDArray]) -> GaussianArrays:
    """Decodes the Gaussians of a file.

    Args:
        path: the file, for messages.
        elements: ``vertex``, ``chunk`` and, if there are higher spherical harmonics, ``sh``.

    Raises:
        FormatError: if an element or property is missing or has the wrong size.
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
    with np.errstate(over="ignore"):  # infinite results are counted and dropped later
        scales = np.exp(between(_three(scale), axes, "scale_"))
    return GaussianArrays(between(_three(position), axes), _rotations(rotation), scales, rgba[:, 3], sh)


def _column(path: Path, table: NDArray, name: str) -> NDArray[np.float64]:
    if name not in (table.dtype.names or ()):
        raise FormatError(f"{path}: the chunks have no {name}; it is damaged")
    return table[name].astype(np.float64)


def _three(packed: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Unpacks 11, 10 and 11 bits to ``[N, 3]`` in [0, 1]."""
    return np.stack(((packed >> 21) / 2047, (packed >> 11 & 1023) / 1023, (packed & 2047) / 2047), 1)


def _rotations(packed: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Unpacks unit quaternions ``[N, 4]`` wxyz."""
    small = np.stack([((packed >> shift & 1023) / 1023 - 0.5) * np.sqrt(2) for shift in (20, 10, 0)], 1)
    return from_smallest_three(packed >> 30, small)


def _higher(path: Path, table: NDArray, count: int) -> NDArray[np.float64]:
    """Decodes higher spherical harmonics ``[N, K, 3]``, K = 3, 8 or 15 coefficients."""
    names = [name for name in (table.dtype.names or ()) if name.startswith("f_rest_")]
    if len(table) != count or len(names) not in (9, 24, 45):
        raise FormatError(f"{path}: {len(table)} rows of {len(names)} f_rest for {count} vertices; it is damaged")
    values = np.stack([table[f"f_rest_{i}"] for i in range(len(names))], 1).astype(np.float64)
    return ((values + 0.5) * (_SH_RANGE / 256) - _SH_RANGE / 2).reshape(count, 3, len(names) // 3).transpose(0, 2, 1)
