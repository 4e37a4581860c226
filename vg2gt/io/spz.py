"""``.spz``, Niantic's compressed Gaussians: a gzip stream of columns, about a tenth of the size of a PLY.

A header of 16 bytes (magic, version, number of Gaussians, degree, fractional bits, flags), then all positions (24-bit
fixed point), opacities, colours, log-scales (a byte each), rotations (version 3: the smallest three of x y z w in 32
bits; version 2: x y z in a byte each) and higher spherical harmonics (a byte each). Axes are those of the PLY, as
Niantic's converter and SuperSplat write them; the format defines none. Format: https://github.com/nianticlabs/spz

Losses compared with a PLY file: positions are rounded to 2^-21 of the scene's extent or 2^-20 units, scales to 3.2 %
and clipped to [4.5e-5, 380], opacities to 1/510, colours to 1/270 and clipped to [-0.44, 1.44], rotations to 1/700,
higher spherical harmonics to 1/256 and clipped to [-1, 1].
"""

from __future__ import annotations

import gzip
import io
import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vg2gt.io.errors import FormatError
from vg2gt.io.files import regular, write_bytes
from vg2gt.io.gaussian_arrays import GaussianArrays, to_arrays, to_gaussians
from vg2gt.types import Gaussians

_HEADER = struct.Struct("<4sIIBBBB")
_MAGIC = b"NGSP"
_DEGREES = {1: 0, 4: 1, 9: 2, 16: 3}  # by number of coefficients
_MOST_BITS = 20  # fractional bits of a position
_ANTIALIASED = 1  # flag of a scene whose opacities a viewer has to compensate for its low-pass filter
_COLOR = 0.15  # a byte holds 0.5 + 0.15 times the constant coefficient


def write_spz(path: str | Path, gaussians: Gaussians, antialiased: bool = False) -> Path:
    """Writes one scene's Gaussians in order, as version 3, atomically; the module lists the losses.

    Args:
        path: file to write.
        gaussians: the scene.
        antialiased: whether the scene was fitted with opacities compensated for the low-pass filter
            (:class:`vg2gt.rendering.RenderOptions`); the file's flag says so to viewers.

    Raises:
        ValueError: if there is more than one scene or a value cannot be written.
    """
    return write_bytes(path, encode_spz(to_arrays(gaussians), antialiased=antialiased))


def encode_spz(arrays: GaussianArrays, version: int = 3, antialiased: bool = False) -> bytes:
    """Encodes Gaussians as a ``.spz`` of version 2 or 3 (:func:`write_spz`)."""
    extent = float(np.abs(arrays.means).max(initial=1e-6))
    bits = min(_MOST_BITS, int(np.floor(np.log2((2**23 - 1) / extent))))
    if bits < 0:
        raise ValueError(
            f"positions reach {extent:.3g} units, but .spz holds at most 8 million: write a PLY, or scale the scene"
        )
    fixed = np.rint(arrays.means * 2.0**bits).astype("<i4")
    columns = (
        fixed[:, :, None].view("u1")[:, :, :3],
        _bytes(arrays.opacities * 255),
        _bytes((arrays.sh[:, 0] * _COLOR + 0.5) * 255),
        _bytes((np.log(arrays.scales) + 10) * 16),
        (_packed if version == 3 else _axes)(np.roll(arrays.quats, -1, 1)),
        _bytes(arrays.sh[:, 1:] * 128 + 128),
    )
    degree = _DEGREES[arrays.sh.shape[1]]
    head = _HEADER.pack(_MAGIC, version, len(fixed), degree, bits, _ANTIALIASED * antialiased, 0)
    return gzip.compress(head + b"".join(column.tobytes() for column in columns), mtime=0)


def read_spz(path: str | Path) -> Gaussians:
    """Reads a ``.spz`` file of version 2 or 3.

    Returns:
        The Gaussians as scene 0, float32.

    Raises:
        FormatError: if the file is damaged or of another version.
    """
    path = Path(path)
    return to_gaussians(path, decode_spz(path, regular(path).read_bytes()))


def decode_spz(path: Path, content: bytes) -> GaussianArrays:
    """Decodes the content of a ``.spz`` file, or of a part of the file ``path`` (:func:`read_spz`)."""
    expected = f"{path}: expected a .spz of version 2 or 3 (splat-transform --spz-version 3 converts others)"
    try:
        with gzip.open(io.BytesIO(content)) as file:
            magic, version, count, degree, bits, _, _ = _HEADER.unpack(file.read(_HEADER.size))
            if magic != _MAGIC or version not in (2, 3) or degree > 3 or bits > 23:
                raise FormatError(f"{expected}, got {magic!r} {version}, degree {degree}, {bits} fractional bits")
            sides = (9, 1, 3, 3, 4 if version == 3 else 3, 3 * ((degree + 1) ** 2 - 1))
            # a damaged count must not allocate more than a gzip stream of this length can hold
            data = file.read(min(count * sum(sides), 1100 * len(content)) + 1)
    except (OSError, EOFError, zlib.error, struct.error) as error:
        raise FormatError(f"{expected}; not one, or damaged: {error}") from error
    if len(data) != count * sum(sides):
        raise FormatError(f"{path}: {count} Gaussians need {count * sum(sides)} bytes, found {len(data)}")
    ends = np.cumsum([count * side for side in sides])[:-1]
    position, alpha, color, scale, rotation, rest = (
        part.reshape(count, side) for part, side in zip(np.split(np.frombuffer(data, "u1"), ends), sides, strict=True)
    )
    fixed = np.zeros((count, 3, 4), "u1")
    fixed[:, :, 1:] = position.reshape(count, 3, 3)
    sh = np.concatenate(
        ((color[:, None] / 255 - 0.5) / _COLOR, (rest.reshape(count, sides[5] // 3, 3) - 128.0) / 128), 1
    )
    return GaussianArrays(
        (fixed.view("<i4")[:, :, 0] >> 8) / 2.0**bits,
        np.roll(_unpacked(rotation), 1, 1),
        np.exp(scale / 16.0 - 10),
        alpha[:, 0] / 255,
        sh,
    )


def _bytes(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.rint(values).clip(0, 255).astype("u1")


def _axes(quats: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Encodes quaternions xyzw as the bytes of x y z of the one with w positive, as version 2 does."""
    unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    return _bytes(np.where(unit[:, 3:] < 0, -unit, unit)[:, :3] * 127.5 + 127.5)


def _packed(quats: NDArray[np.floating]) -> NDArray[np.uint32]:
    """Encodes quaternions xyzw as the place of the largest component and the others of the one with it positive."""
    place = np.abs(quats).argmax(1)[:, None]
    unit = quats / (np.linalg.norm(quats, axis=1, keepdims=True) * np.sign(np.take_along_axis(quats, place, 1)))
    word = place[:, 0].astype("<u4")
    for column in unit[np.arange(4) != place].reshape(-1, 3).T:
        word = word << 10 | (column < 0).astype("<u4") << 9 | np.rint(abs(column) * np.sqrt(2) * 511).astype("<u4")
    return word


def _unpacked(packed: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Decodes the bytes of version 2 or 3 to unit quaternions ``[N, 4]`` xyzw."""
    if packed.shape[1] == 3:
        axis = packed / 127.5 - 1
        return np.concatenate((axis, np.sqrt(np.maximum(1 - (axis**2).sum(1, keepdims=True), 0))), 1)
    word = np.ascontiguousarray(packed).view("<u4")
    parts = word >> np.array([20, 10, 0], "<u4") & 1023
    others = np.where(parts >> 9, -1, 1) * (parts & 511) / (511 * np.sqrt(2))
    largest = np.arange(4) == word >> 30
    quats = np.empty(largest.shape)
    quats[~largest] = others.ravel()
    quats[largest] = np.sqrt(np.maximum(1 - (others**2).sum(1), 0))
    return quats
