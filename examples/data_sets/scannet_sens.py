"""Reader of ScanNet's raw ``.sens`` streams, without exporting them.

All numbers are little endian. Header: version (uint32, 4), sensor name (uint64 length, bytes), 4x4 float32 intrinsics
and extrinsics of colour, then of depth, compression types (2 x int32), width and height of colour, then of depth
(4 x uint32), depth units per metre (float32), number of frames (uint64). Frame: 4x4 float32 pose (camera-to-world),
timestamps of colour and depth (2 x uint64), lengths of the two images (2 x uint64), bytes of the images.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from vg2gt.data.base import DataError
from vg2gt.data.sources.index import SceneIndex, make_index
from vg2gt.data.sources.rgbd import ScanNet
from vg2gt.io.files import regular
from vg2gt.io.image_files import Size, read_color

_VERSION = 4
_COLOR_TYPES, _DEPTH_TYPES = (1, 2), (0, 1)  # PNG, JPEG; raw, zlib
_LARGEST_SIDE = 1 << 14
_FRAME_HEADER = "<64s4Q"


class ScanNetSens(ScanNet):
    """Scans in ScanNet's raw ``.sens`` files; each file is a scene, and frames are numbered as in an export.

    Arguments, frames, depth and intrinsics are those of ``ScanNet``. Images are decoded directly from the file. Without
    ``index_cache``, every process first reads the headers of all frames of a scan.
    """

    layout = "sceneNNNN_NN.sens, there or up to two folders deeper"

    def find(self, root: Path) -> Mapping[str, Path]:
        """Returns ``.sens`` files by name; raises DataError if two have the same name."""
        found: dict[str, Path] = {}
        for path in sorted(path for pattern in ("*", "*/*", "*/*/*") for path in root.glob(pattern + ".sens")):
            if path.stem in found:
                raise DataError(f"two scans are called {path.stem}: {found[path.stem]} and {path}; remove one")
            found[path.stem] = path
        return found

    def watched(self, scene: str, folder: Path) -> Sequence[Path | None]:
        """Returns the file of the scene."""
        return (folder,)

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Reads the headers of all frames.

        Raises:
            DataError: if the file is missing, damaged or truncated, or has an unsupported compression.
        """
        try:
            with regular(folder).open("rb") as file:
                intrinsics, color_size, size, coding = _read_header(file)
                poses, color, depth = _read_frames(file, int(coding[2]), folder.stat().st_size)
        except (OSError, ValueError) as error:
            raise DataError(f"cannot read {folder} of scene {scene}: {error}; export the scan again") from error
        files = dict.fromkeys(range(len(poses)), folder)
        index = make_index(
            scene, folder, files, files, dict(enumerate(poses)), intrinsics,
            color_size=color_size, size=size, depth_size=size,
        )  # fmt: skip
        kept = list(index.frame_ids)
        return replace(index, extra={"color": color[kept], "depth": depth[kept], "depth_coding": coding[:2]})

    def read_color(self, index: SceneIndex, row: int) -> NDArray[np.uint8]:
        """Decodes a colour image of the stream."""
        path, frame = index.color[row], index.frame_ids[row]
        content = _read_span(path, index.name, index.extra["color"][row])
        return read_color(path, f"{index.name} (frame {frame})", index.color_size, content)

    def read_depth(self, index: SceneIndex, row: int, size: Size) -> NDArray[np.float32]:
        """Decodes a depth image of the stream."""
        path, frame = index.depth[row], index.frame_ids[row]
        content = _read_span(path, index.name, index.extra["depth"][row])
        compression, scale = index.extra["depth_coding"].tolist()
        where = f"frame {frame} in {path} of scene {index.name}"
        expected = 2 * size[0] * size[1]
        if compression == 1:
            try:
                content = zlib.decompressobj().decompress(content, expected + 1)
            except zlib.error as error:
                raise DataError(f"cannot decompress the depth of {where}: {error}") from error
        if len(content) != expected:
            raise DataError(f"the depth of {where} is not of {size[1]}x{size[0]} pixels")
        return (np.frombuffer(content, "<u2").reshape(size) / scale).astype(np.float32)


def _read_span(path: Path, scene: str, span: NDArray[np.int64]) -> bytes:
    """Reads the bytes of an image, given by first byte and length."""
    try:
        with regular(path).open("rb") as file:
            file.seek(int(span[0]))
            content = file.read(int(span[1]))
    except OSError as error:
        raise DataError(f"cannot read {path} of scene {scene}: {error}") from error
    if len(content) != span[1]:
        raise DataError(f"{path} of scene {scene} has become shorter since it was indexed; restore it")
    return content


def _read_header(file: BinaryIO) -> tuple[NDArray[np.float64], Size, Size, NDArray[np.float64]]:
    """Depth intrinsics, sizes of colour and depth, and an array of depth compression, depth scale and frame count."""
    (version,) = _unpack(file, "<I")
    if version != _VERSION:
        raise ValueError(f"version {version} of the format, expected {_VERSION}")
    (name_length,) = _unpack(file, "<Q")
    file.seek(min(name_length, 1 << 16), 1)
    matrices = np.array(_unpack(file, "<64f")).reshape(4, 4, 4)
    color_type, depth_type, *sides = _unpack(file, "<2i4I")
    if color_type not in _COLOR_TYPES or depth_type not in _DEPTH_TYPES:
        raise ValueError(f"colour of type {color_type} and depth of type {depth_type}; known are 1, 2 and 0, 1")
    if not all(0 < side <= _LARGEST_SIDE for side in sides):
        raise ValueError(f"images of {sides[0]}x{sides[1]} and {sides[2]}x{sides[3]} pixels")
    scale, count = _unpack(file, "<fQ")
    if not 1 <= scale <= 1e6:
        raise ValueError(f"{scale} depth units per metre")
    coding = np.array([depth_type, scale, min(count, 1 << 53)])
    return matrices[2, :3, :3], (sides[1], sides[0]), (sides[3], sides[2]), coding


def _read_frames(
    file: BinaryIO, count: int, length: int
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Poses, and spans of the colour and depth images; allocates nothing by ``count``, which may be damaged."""
    poses, color, depth = [], [], []
    while len(poses) < count:
        pose, _, _, color_length, depth_length = _unpack(file, _FRAME_HEADER)
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


def _unpack(file: BinaryIO, form: str) -> tuple[Any, ...]:
    content = file.read(struct.calcsize(form))
    if len(content) != struct.calcsize(form):
        raise ValueError(f"it ends after {file.tell()} bytes, within a header")
    return struct.unpack(form, content)
