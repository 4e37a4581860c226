"""COLMAP's text model files: one record a line (images: two), ``#`` begins a comment line."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np

from vg2gt.io.colmap_records import ColmapCamera, ColmapImage, ColmapPoints, check_camera
from vg2gt.io.errors import FormatError
from vg2gt.io.files import regular

_CAMERA = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS..."
_IMAGE = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
_FEATURES = "X Y POINT3D_ID, repeated"
_POINT = "POINT3D_ID X Y Z R G B ERROR, then IMAGE_ID POINT2D_IDX repeated"

Record = TypeVar("Record")


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Line numbers from 1 and lines, comments left out."""
    try:
        text = regular(path).read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise FormatError(f"{path}: not UTF-8 text ({error}); the file is damaged or not a text model") from error
    for number, line in enumerate(text.split("\n"), 1):
        if not line.lstrip().startswith("#"):
            yield number, line.strip()


def _parse(path: Path, number: int, line: str, parse: Callable[[str], Record], layout: str) -> Record:
    try:
        return parse(line)
    except FormatError as error:
        raise FormatError(f"{path}, line {number}: {error}") from error
    except (ValueError, OverflowError) as error:
        raise FormatError(
            f"{path}, line {number}: expected {layout}, got {line[:80]!r} ({error}); the file is truncated or damaged"
        ) from error


def _integer(text: str, bits: int = 32) -> int:
    """An unsigned integer that the binary format could hold too."""
    value = int(text)
    if not 0 <= value < 1 << bits:
        raise ValueError(f"{value} is out of range")
    return value


def _camera(line: str) -> ColmapCamera:
    number, model, width, height, *params = line.split()
    camera = ColmapCamera(_integer(number), model, int(width), int(height), tuple(map(float, params)))
    check_camera(camera, f"camera {number}")
    return camera


def _features(line: str) -> tuple[np.ndarray, np.ndarray]:
    fields = line.split()
    if len(fields) % 3:
        raise ValueError(f"{len(fields)} numbers are not a multiple of 3")
    points2d = np.array([fields[0::3], fields[1::3]], np.float64).T.copy()
    return points2d, np.array([-1 if text == "-1" else _integer(text, 63) for text in fields[2::3]], np.int64)


def _image(line: str) -> ColmapImage:
    fields = line.split(maxsplit=9)
    if len(fields) != 10:
        raise ValueError(f"{len(fields)} fields instead of 10")
    qw, qx, qy, qz, tx, ty, tz = map(float, fields[1:8])
    none = np.zeros((0, 2)), np.zeros(0, np.int64)
    return ColmapImage(
        _integer(fields[0]), (qw, qx, qy, qz), (tx, ty, tz), _integer(fields[8]), fields[9].strip(), *none
    )


def read_cameras(path: Path) -> list[ColmapCamera]:
    """Reads ``cameras.txt``.

    Raises:
        FormatError: if a line is damaged.
    """
    return [_parse(path, number, line, _camera, _CAMERA) for number, line in _lines(path) if line]


def read_images(path: Path) -> list[ColmapImage]:
    """Reads ``images.txt``; the second line of an image without features is empty.

    Raises:
        FormatError: if a line is damaged.
    """
    images = []
    lines = _lines(path)
    for number, line in lines:
        if not line:
            continue
        image = _parse(path, number, line, _image, _IMAGE)
        number, line = next(lines, (number + 1, ""))
        features = _parse(path, number, line, _features, _FEATURES)
        images.append(ColmapImage(image.id, image.quat, image.translation, image.camera_id, image.name, *features))
    return images


def _point(line: str) -> tuple[int, list[float], list[int], float, list[int]]:
    fields = line.split()
    if len(fields) < 8 or len(fields) % 2:
        raise ValueError(f"{len(fields)} fields, not 8 and pairs")
    color = [_integer(text, 8) for text in fields[4:7]]
    track = [_integer(text) for text in fields[8:]]
    return _integer(fields[0], 63), [float(text) for text in fields[1:4]], color, float(fields[7]), track


def read_points(path: Path) -> ColmapPoints:
    """Reads ``points3D.txt``.

    Raises:
        FormatError: if a line is damaged.
    """
    rows = [_parse(path, number, line, _point, _POINT) for number, line in _lines(path) if line]
    if not rows:
        return ColmapPoints.empty()
    ids, positions, colors, errors, tracks = zip(*rows, strict=True)
    return ColmapPoints(
        np.array(ids, np.int64),
        np.array(positions, np.float64),
        np.array(colors, np.uint8),
        np.array(errors, np.float64),
        np.array([value for track in tracks for value in track], np.int64).reshape(-1, 2),
        np.array([len(track) // 2 for track in tracks], np.int64),
    )


def cameras_content(cameras: list[ColmapCamera]) -> bytes:
    """What ``cameras.txt`` holds; numbers are written so that they read back exactly."""
    lines = [f"# Cameras, one a line: {_CAMERA}"]
    lines += [f"{c.id} {c.model} {c.width} {c.height} {_joined(c.params)}" for c in cameras]
    return _content(lines)


def images_content(images: list[ColmapImage]) -> bytes:
    """What ``images.txt`` holds.

    Raises:
        ValueError: if an image's name has a blank in it, which COLMAP's text format cannot hold.
    """
    lines = [f"# Images, two lines each: {_IMAGE}", f"# and {_FEATURES}"]
    for image in images:
        if len(image.name.split()) != 1:
            raise ValueError(
                f"image name {image.name!r} has blanks, which a COLMAP text model cannot hold; write a binary model"
            )
        lines.append(f"{image.id} {_joined(image.quat)} {_joined(image.translation)} {image.camera_id} {image.name}")
        features = zip(image.points2d.tolist(), image.point3d_ids.tolist(), strict=True)
        lines.append(" ".join(f"{x!r} {y!r} {point}" for (x, y), point in features))
    return _content(lines)


def points_content(points: ColmapPoints) -> bytes:
    """What ``points3D.txt`` holds."""
    lines = [f"# Points, one a line: {_POINT}"]
    ends = np.cumsum(points.track_lengths)
    columns = (points.ids, points.positions, points.colors, points.errors, points.track_lengths, ends)
    for number, position, color, error, length, end in zip(*(column.tolist() for column in columns), strict=True):
        track = points.tracks[end - length : end].ravel().tolist()
        lines.append(_joined((number, *position, *color, error, *track)))
    return _content(lines)


def _joined(values: tuple) -> str:
    # str() of a NumPy float has all its digits, its repr() has its type's name too
    return " ".join(str(value) for value in values)


def _content(lines: list[str]) -> bytes:
    return ("\n".join(lines) + "\n").encode()
