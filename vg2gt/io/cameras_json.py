"""``cameras.json``: the posed cameras of a scene, each with its own image size, in our conventions.

The file is a list of objects ``name``, ``width``, ``height``, ``intrinsics`` (3 rows of 3, integer pixel centres) and
``world_to_camera`` (4 rows of 4, OpenCV axes). A reconstruction adds ``photo`` (the whole photograph's camera),
``similarity`` (4 rows of 4, transform from this file's world to that of the given or estimated cameras) and, if known,
``metres_per_unit``. Other fields are ignored. The file of the same name from 3D Gaussian Splatting has other fields; it
is refused, naming the missing one.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from vg2gt.io.errors import FormatError
from vg2gt.io.files import read_json, write_json
from vg2gt.types import Cameras

_MAX_SIZE = 1 << 16  # pixels along an image's side
_ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class Photo:
    """The camera of a whole photograph; a view may be a resized crop of it.

    Attributes:
        name: file name.
        width: image width in pixels, upright and undistorted.
        height: image height in pixels, upright and undistorted.
        intrinsics: ``[3, 3]`` float64 in pixels, integer pixel centres.
        lens: distortion of the file (``vg2gt.data.sources.undistortion.lens_text``); empty: none.
    """

    name: str
    width: int
    height: int
    intrinsics: NDArray[np.float64]
    lens: str = ""


@dataclass(frozen=True, eq=False)
class NamedCamera:
    """One pinhole camera.

    Attributes:
        name: name of the view, usually its image file relative to the image folder; not empty.
        width: image width in pixels.
        height: image height in pixels.
        intrinsics: ``[3, 3]`` float64 in pixels, integer pixel centres.
        world_to_camera: ``[4, 4]`` float64, OpenCV axes, scene units.
        photo: the whole photograph's camera, if known.
        similarity: ``[4, 4]`` transform from this world to that of the given or estimated cameras, if known.
        metres_per_unit: metres per scene unit, if known.
    """

    name: str
    width: int
    height: int
    intrinsics: NDArray[np.float64]
    world_to_camera: NDArray[np.float64]
    photo: Photo | None = None
    similarity: NDArray[np.float64] | None = None
    metres_per_unit: float | None = None

    def cameras(self) -> Cameras:
        """Returns the camera as input of the renderer: one scene, one view, float32."""
        pose, intrinsics = (torch.from_numpy(m).float()[None, None] for m in (self.world_to_camera, self.intrinsics))
        return Cameras(pose, intrinsics, (self.height, self.width))

    def fields(self) -> dict[str, Any]:
        """Returns the camera as the plain values of its JSON object."""
        plain = json.loads(json.dumps(asdict(self), default=lambda values: values.tolist()))
        return {name: value for name, value in plain.items() if value is not None}


def invert_pose(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverts rigid transforms ``[..., 4, 4]``; rotations are transposed, which adds no rounding error."""
    inverse = np.zeros_like(pose)
    rotation = pose[..., :3, :3].swapaxes(-1, -2)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3:] = -rotation @ pose[..., :3, 3:]
    inverse[..., 3, 3] = 1
    return inverse


def named_cameras(cameras: Cameras, names: Sequence[str]) -> list[NamedCamera]:
    """Returns one named camera per view of a scene.

    Raises:
        ValueError: if there is more than one scene, or not one name per view.
    """
    scenes, views = cameras.world_to_camera.shape[:2]
    if scenes != 1 or views != len(names):
        raise ValueError(f"expected 1 scene and a name per view, got {scenes}, {views} views, {len(names)} names")
    poses, intrinsics = (t[0].detach().cpu().double().numpy() for t in (cameras.world_to_camera, cameras.intrinsics))
    height, width = cameras.size
    return [NamedCamera(name, width, height, k, pose) for name, k, pose in zip(names, intrinsics, poses, strict=True)]


def write_cameras_json(path: str | Path, cameras: Sequence[NamedCamera]) -> Path:
    """Writes cameras in order, atomically and without loss of float64 precision.

    Raises:
        ValueError: if a camera is invalid: wrong shape, a value that is not finite, no valid rotation or focal length.
    """
    content = [camera.fields() for camera in cameras]
    for index, entry in enumerate(content):
        _camera(f"cameras[{index}]", entry)
    return write_json(path, content)


def read_cameras_json(path: str | Path) -> list[NamedCamera]:
    """Reads the cameras of a file, in order.

    Raises:
        FormatError: if the file is not JSON or a field is wrong, naming the file, the entry and the field.
    """
    path = Path(path)
    content = read_json(path)
    if not isinstance(content, list):
        raise FormatError(f"{path}: expected a list of cameras, got {type(content).__name__}")
    return [_camera(f"{path}: [{index}]", entry) for index, entry in enumerate(content)]


def _camera(place: str, entry: Any) -> NamedCamera:
    """Checks and converts one entry; ``place`` locates it in messages."""
    fields = Fields(f"{place}.", entry)
    name = fields.get("name", str, "the view's name")
    if not name:
        raise fields.wrong("name", "the view's name")
    pose = _matrix(fields, "world_to_camera", 4)
    check_rigid(f"{place}.world_to_camera", pose, _ROTATION_TOLERANCE)
    width, height, intrinsics = _optics(fields)
    photo = entry.get("photo")
    if photo is not None:
        inside = Fields(f"{place}.photo.", photo)
        title, lens = (inside.get(key, str, "a text", required=True) for key in ("name", "lens"))
        photo = Photo(title, *_optics(inside), lens)
    similarity = None if entry.get("similarity") is None else _matrix(fields, "similarity", 4)
    metres = fields.number("metres_per_unit", 0, 1e30)
    name = name.replace("\\", "/")  # from Windows
    return NamedCamera(name, width, height, intrinsics, pose, photo, similarity, metres)


def _optics(fields: Fields) -> tuple[int, int, NDArray[np.float64]]:
    """Width, height and intrinsics of an entry."""
    intrinsics = _matrix(fields, "intrinsics", 3)
    focal = intrinsics[[0, 1], [0, 1]]
    if (focal <= 0).any() or np.abs(intrinsics[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]] - [0, 0, 0, 0, 1]).max() > 1e-9:
        raise fields.wrong("intrinsics", "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive focal lengths, no skew")
    width, height = (fields.pixels(name, required=True) or 0 for name in ("width", "height"))
    return width, height, intrinsics


def _matrix(fields: Fields, name: str, size: int) -> NDArray[np.float64]:
    matrix = fields.matrix(name, (size,), size)
    if not np.isfinite(matrix).all():
        raise fields.wrong(name, f"{size} rows of {size} finite numbers")
    return matrix


class Fields:
    """The fields of one JSON object; every error (``FormatError``) names the place and the field.

    Args:
        place: prefix of field names in messages, such as ``cameras.json: [1].``.
        content: the parsed object.
    """

    def __init__(self, place: str, content: Any) -> None:
        if not isinstance(content, dict):
            raise FormatError(f"{place.rstrip('.: ')} should be an object, got {short(content)}")
        self.place, self.content = place, content

    def wrong(self, name: str, expected: str) -> FormatError:
        """Returns the error for a field that is missing or not as expected."""
        return FormatError(f"{self.place}{name} is {short(self.content.get(name))}, expected {expected}")

    def get(self, name: str, kind: type, expected: str, required: bool = False) -> Any:
        """Returns a field of type ``kind``; None if it is missing, unless ``required``."""
        value = self.content.get(name)
        if not isinstance(value, kind) and (required or value is not None):
            raise self.wrong(name, expected)
        return value

    def number(self, name: str, low: float = -math.inf, high: float = math.inf) -> float | None:
        """Returns a finite number strictly between ``low`` and ``high``; None if it is missing."""
        value = self.content.get(name)
        if value is None:
            return None
        if type(value) not in (int, float) or abs(value) > 1e300 or not low < value < high:
            limits = "" if low == -math.inf else f" greater than {low:g}" + (f" and below {high:g}" * (high < math.inf))
            raise self.wrong(name, f"a finite number{limits}")
        return float(value)

    def pixels(self, name: str, required: bool = False) -> int | None:
        """Returns a whole number of pixels; None if it is missing and not ``required``."""
        value = self.number(name, 0, _MAX_SIZE)
        if (required and value is None) or (value is not None and value != round(value)):
            raise self.wrong(name, "a whole number of pixels")
        return None if value is None else round(value)

    def matrix(self, name: str, rows: Sequence[int], columns: int) -> NDArray[np.float64]:
        """Returns a matrix whose number of rows is one of ``rows``; its values may be NaN or infinite."""
        value = self.content.get(name)
        lists = value if isinstance(value, list) and len(value) in rows else [None]
        try:
            if all(isinstance(row, list) and all(type(number) in (int, float) for number in row) for row in lists):
                return np.array(lists, np.float64).reshape(len(lists), columns)
        except (ValueError, OverflowError):
            pass
        raise self.wrong(name, f"{' or '.join(map(str, rows))} rows of {columns} finite numbers")


def check_rigid(place: str, matrix: NDArray[np.float64], tolerance: float) -> None:
    """Checks that a finite ``[4, 4]`` matrix is a rotation, orthonormal within ``tolerance``, and a translation."""
    rotation = matrix[:3, :3]
    error = np.abs(rotation.T @ rotation - np.eye(3)).max() if np.abs(rotation).max() < 2 else math.inf
    if error > tolerance or np.linalg.det(rotation) < 0 or np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        what = f"is not a rotation and a translation (R'R differs from the identity by {error:.2g})"
        raise FormatError(f"{place} {what}; remove scale, shear and mirroring")


def short(value: Any) -> str:
    """Formats a value for a message, in at most 80 characters."""
    text = type(value).__name__ if isinstance(value, dict | list) else "missing" if value is None else repr(value)
    return text if len(text) <= 80 else text[:77] + "..."
