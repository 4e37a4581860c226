"""COLMAP's binary model files: little endian, a 64-bit count, then the records one after another.

No count read from a file is trusted: it is compared with the bytes that are left before anything is allocated.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vg2gt.io.colmap_records import (
    CAMERA_MODELS,
    MODEL_NAMES,
    ColmapCamera,
    ColmapImage,
    ColmapPoints,
    check_camera,
)
from vg2gt.io.errors import FormatError
from vg2gt.io.files import regular

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height
_IMAGE = struct.Struct("<I7dI")  # id, quaternion, translation, camera
_POINT = struct.Struct("<Q3d3BdQ")  # id, position, colour, error, track length
_FEATURE = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_NAME_LIMIT = 4096


class _Cursor:
    """Reads a byte string from front to back and says where it broke off."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data = regular(path).read_bytes()
        self.position = 0

    @property
    def place(self) -> str:
        """The file and byte, for messages."""
        return f"{self.path}, byte {self.position}"

    def need(self, size: int, what: str) -> None:
        """Raises a ``FormatError`` where fewer bytes are left than ``what`` takes."""
        left = len(self.data) - self.position
        if size > left:
            raise FormatError(
                f"{self.place}: {what} needs {size} bytes, {left} are left; the file is truncated or damaged"
            )

    def unpack(self, layout: struct.Struct, what: str) -> tuple:
        """The next record."""
        self.need(layout.size, what)
        values = layout.unpack_from(self.data, self.position)
        self.position += layout.size
        return values

    def count(self, smallest: int, what: str) -> int:
        """How many entries follow, of at least ``smallest`` bytes each; so many must be left."""
        (count,) = self.unpack(_COUNT, f"the number of {what}")
        self.need(count * smallest, f"a list of {count} {what}")
        return count

    def array(self, dtype: np.dtype, count: int, what: str) -> NDArray:
        """The next ``count`` numbers, as a view of the file's bytes."""
        self.need(count * dtype.itemsize, f"{count} {what}")
        values = np.frombuffer(self.data, dtype, count, self.position)
        self.position += count * dtype.itemsize
        return values

    def name(self) -> str:
        """An image's name, which ends with a zero byte."""
        end = self.data.find(b"\0", self.position, self.position + _NAME_LIMIT)
        if end < 0:
            raise FormatError(f"{self.place}: an image name has no end; the file is truncated or damaged")
        try:
            name = self.data[self.position : end].decode()
        except UnicodeDecodeError as error:
            raise FormatError(f"{self.place}: an image name is not UTF-8 ({error}); the file is damaged") from error
        self.position = end + 1
        return name

    def finish(self) -> None:
        """Raises a ``FormatError`` where bytes are left over."""
        left = len(self.data) - self.position
        if left:
            raise FormatError(f"{self.place}: {left} bytes follow the last record; the file is damaged")


def read_cameras(path: Path) -> list[ColmapCamera]:
    """Reads ``cameras.bin``.

    Raises:
        FormatError: if it is damaged.
    """
    cursor = _Cursor(path)
    cameras = []
    for _ in range(cursor.count(_CAMERA.size, "cameras")):
        place = cursor.place
        number, model, width, height = cursor.unpack(_CAMERA, "a camera")
        if model not in MODEL_NAMES:
            raise FormatError(f"{place}: unknown camera model number {model}, known are 0 to {max(MODEL_NAMES)}")
        name = MODEL_NAMES[model]
        params = cursor.array(np.dtype("<f8"), len(CAMERA_MODELS[name][1]), f"parameters of {name}")
        cameras.append(ColmapCamera(number, name, width, height, tuple(params.tolist())))
        check_camera(cameras[-1], place)
    cursor.finish()
    return cameras


def read_images(path: Path) -> list[ColmapImage]:
    """Reads ``images.bin``.

    Raises:
        FormatError: if it is damaged.
    """
    cursor = _Cursor(path)
    images = []
    for _ in range(cursor.count(_IMAGE.size + 1 + _COUNT.size, "images")):
        number, qw, qx, qy, qz, tx, ty, tz, camera = cursor.unpack(_IMAGE, "an image")
        name = cursor.name()
        features = cursor.array(_FEATURE, cursor.count(_FEATURE.itemsize, "features"), "features")
        images.append(
            ColmapImage(
                number,
                (qw, qx, qy, qz),
                (tx, ty, tz),
                camera,
                name,
                features["xy"].astype(np.float64),
                features["point"].astype(np.int64),
            )
        )
    cursor.finish()
    return images


def read_points(path: Path) -> ColmapPoints:
    """Reads ``points3D.bin``.

    Raises:
        FormatError: if it is damaged.
    """
    cursor = _Cursor(path)
    observation = np.dtype("<u4")
    rows, tracks = [], []
    for _ in range(cursor.count(_POINT.size, "points")):
        rows.append(cursor.unpack(_POINT, "a point"))
        tracks.append(cursor.array(observation, 2 * rows[-1][-1], "numbers of a track"))
    cursor.finish()
    if not rows:
        return ColmapPoints.empty()
    ids, x, y, z, red, green, blue, errors, lengths = zip(*rows, strict=True)
    if max(ids) >= 1 << 63:
        raise FormatError(f"{path}: point number {max(ids)} is out of range; the file is damaged")
    return ColmapPoints(
        np.array(ids, np.int64),
        np.array((x, y, z), np.float64).T.copy(),
        np.array((red, green, blue), np.uint8).T.copy(),
        np.array(errors, np.float64),
        np.concatenate(tracks).astype(np.int64).reshape(-1, 2),
        np.array(lengths, np.int64),
    )


def cameras_content(cameras: list[ColmapCamera]) -> bytes:
    """What ``cameras.bin`` holds."""
    parts = [_COUNT.pack(len(cameras))]
    for camera in cameras:
        parts.append(_CAMERA.pack(camera.id, CAMERA_MODELS[camera.model][0], camera.width, camera.height))
        parts.append(np.asarray(camera.params, "<f8").tobytes())
    return b"".join(parts)


def images_content(images: list[ColmapImage]) -> bytes:
    """What ``images.bin`` holds."""
    parts = [_COUNT.pack(len(images))]
    for image in images:
        features = np.empty(len(image.points2d), _FEATURE)
        features["xy"], features["point"] = image.points2d, image.point3d_ids
        parts.append(_IMAGE.pack(image.id, *image.quat, *image.translation, image.camera_id))
        parts += [image.name.encode(), b"\0", _COUNT.pack(len(features)), features.tobytes()]
    return b"".join(parts)


def points_content(points: ColmapPoints) -> bytes:
    """What ``points3D.bin`` holds."""
    parts = [_COUNT.pack(len(points))]
    ends = np.cumsum(points.track_lengths)
    tracks = points.tracks.astype("<u4")
    columns = (points.ids, points.positions, points.colors, points.errors, points.track_lengths, ends)
    for number, position, color, error, length, end in zip(*(column.tolist() for column in columns), strict=True):
        parts.append(_POINT.pack(number, *position, *color, error, length))
        parts.append(tracks[end - length : end].tobytes())
    return b"".join(parts)
