"""The ``.sens`` stream of ScanNet: a header, then frames one after another, each with its own header.

All numbers are little endian: version (uint32, 4), sensor name (uint64 length, bytes), 4x4 float32 intrinsics and
extrinsics of colour and then of depth, compression types (2 x int32), widths and heights of colour and of depth
(4 x uint32), depth units per metre (float32), number of frames (uint64). A frame is its 4x4 float32 pose
(camera-to-world), timestamps of colour and depth (2 x uint64), lengths of the two images (2 x uint64), and their bytes.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from vg2gt.io.errors import DataError
from vg2gt.io.files import regular
from vg2gt.io.image_files import Size

_VERSION = 4
_PNG_COLOR, _JPEG_COLOR = 1, 2
_RAW_DEPTH, _ZLIB_DEPTH = 0, 1
_LONGEST_NAME = 1 << 16
_LARGEST_SIDE = 1 << 14
_FINEST_DEPTH = 1e6
_MATRICES = 4 * 64
_FRAME_HEADER = struct.Struct("<64s4Q")


@dataclass(frozen=True)
class SensStream:
    """What a ``.sens`` file holds, and where.

    Attributes:
        color_size: ``(height, width)`` of the colour images.
        depth_size: of the depth images.
        depth_intrinsics: ``[3, 3]`` of the depth images.
        depth_compression: 0: raw uint16, 1: zlib.
        depth_scale: stored units per metre.
        color: ``[n, 2]`` first byte and length of each colour image.
        depth: ``[n, 2]`` of each depth image.
    """

    color_size: Size
    depth_size: Size
    depth_intrinsics: NDArray[np.float64]
    depth_compression: int
    depth_scale: float
    color: NDArray[np.int64]
    depth: NDArray[np.int64]


def scan_sens(path: Path, scene: str) -> tuple[SensStream, NDArray[np.float64]]:
    """Reads the headers of a ``.sens`` file, passing over the images.

    Returns:
        Where everything is, and ``[n, 4, 4]`` camera-to-world poses; those of lost frames are not finite.

    Raises:
        DataError: if the file is missing, damaged or truncated, or compressed in a way that is not read.
    """
    try:
        length = path.stat().st_size
        with regular(path).open("rb") as file:
            return _scan(file, length)
    except (OSError, ValueError) as error:
        raise DataError(f"cannot read {path} of scene {scene}: {error}; export the scan again") from error


def read_span(path: Path, scene: str, span: NDArray[np.int64]) -> bytes:
    """Reads the bytes of one image.

    Raises:
        DataError: if the file is missing or has become shorter.
    """
    try:
        with regular(path).open("rb") as file:
            file.seek(int(span[0]))
            content = file.read(int(span[1]))
    except OSError as error:
        raise DataError(f"cannot read {path} of scene {scene}: {error}") from error
    if len(content) != span[1]:
        raise DataError(f"{path} of scene {scene} has become shorter since it was indexed; restore it")
    return content


def decode_depth(content: bytes, compression: int, size: Size, where: str) -> NDArray[np.uint16]:
    """Decodes a depth image ``[h, w]``.

    Raises:
        DataError: if the content is damaged or not of this size.
    """
    expected = 2 * size[0] * size[1]
    if compression == _ZLIB_DEPTH:
        try:
            content = zlib.decompressobj().decompress(content, expected + 1)
        except zlib.error as error:
            raise DataError(f"cannot decompress the depth of {where}: {error}") from error
    if len(content) != expected:
        raise DataError(f"the depth of {where} is not of {size[1]}x{size[0]} pixels")
    return np.frombuffer(content, "<u2").reshape(size)


def _scan(file: BinaryIO, length: int) -> tuple[SensStream, NDArray[np.float64]]:
    (version,) = _unpack(file, "<I")
    if version != _VERSION:
        raise ValueError(f"version {version} of the format, expected {_VERSION}")
    (name_length,) = _unpack(file, "<Q")
    if name_length > _LONGEST_NAME:
        raise ValueError(f"a sensor's name of {name_length} bytes")
    file.seek(name_length, 1)
    # Intrinsics and extrinsics of colour, then of depth.
    matrices = np.frombuffer(_read(file, _MATRICES), "<f4").reshape(4, 4, 4).astype(np.float64)
    color_type, depth_type, *sides = _unpack(file, "<2i4I")
    if color_type not in (_PNG_COLOR, _JPEG_COLOR) or depth_type not in (_RAW_DEPTH, _ZLIB_DEPTH):
        raise ValueError(
            f"colour of type {color_type} and depth of type {depth_type}; known are 1 and 2 (PNG, JPEG) for colour, "
            "0 and 1 (raw, zlib) for depth"
        )
    if not all(0 < side <= _LARGEST_SIDE for side in sides):
        raise ValueError(f"images of {sides[0]}x{sides[1]} and {sides[2]}x{sides[3]} pixels")
    depth_scale, count = _unpack(file, "<fQ")
    if not 1 <= depth_scale <= _FINEST_DEPTH:
        raise ValueError(f"{depth_scale} depth units per metre")
    poses, color, depth = _scan_frames(file, length, count)
    stream = SensStream(
        color_size=(sides[1], sides[0]),
        depth_size=(sides[3], sides[2]),
        depth_intrinsics=matrices[2, :3, :3],
        depth_compression=depth_type,
        depth_scale=depth_scale,
        color=color,
        depth=depth,
    )
    return stream, poses


def _scan_frames(
    file: BinaryIO, length: int, count: int
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Poses, and where the colour and depth images are; nothing is sized by ``count``, which may be damaged."""
    poses, color, depth = [], [], []
    while len(poses) < count:
        pose, _, _, color_length, depth_length = _FRAME_HEADER.unpack(_read(file, _FRAME_HEADER.size))
        start = file.tell()
        end = start + color_length + depth_length
        if end > length:
            raise ValueError(f"it ends within frame {len(poses)} of {count}")
        poses.append(np.frombuffer(pose, "<f4").reshape(4, 4))
        color.append((start, color_length))
        depth.append((start + color_length, depth_length))
        file.seek(end)
    if not poses:
        raise ValueError("it holds no frame")
    return np.stack(poses).astype(np.float64), np.array(color, np.int64), np.array(depth, np.int64)


def _unpack(file: BinaryIO, form: str) -> tuple:
    return struct.unpack(form, _read(file, struct.calcsize(form)))


def _read(file: BinaryIO, count: int) -> bytes:
    content = file.read(count)
    if len(content) != count:
        raise ValueError(f"it ends after {file.tell()} bytes, within a header")
    return content
