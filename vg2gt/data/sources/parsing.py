"""Small readers and checks that all loaders share.

All of them raise ``DataError`` where a file is missing or damaged, or holds something else,
naming the file and the scene.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vg2gt.data.base import DataError
from vg2gt.io.cameras_json import invert_pose
from vg2gt.io.errors import FormatError
from vg2gt.io.files import regular

log = logging.getLogger(__name__)

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".tif", ".tiff", ".webp", ".bmp")

CORNER_TO_CENTER = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
"""Subtracted from intrinsics whose principal point counts from the corner of the first pixel, not from its centre."""

_THREADS = 8
_ROTATION_TOLERANCE = 0.02
_FAR_OFF = 50.0  # focal lengths
_NO_SKEW = 1e-3  # of the focal length: half a pixel at the border of an image
_LARGEST = float(np.finfo(np.float32).max)


def read_numbers(path: Path, scene: str, skip_lines: int = 0) -> NDArray[np.float64]:
    """Reads a table of numbers, at least one row; ``#`` begins a comment."""
    rows = [line.split("#")[0].split() for line in _read_lines(path, scene)[skip_lines:]]
    try:
        table = np.array([[float(word) for word in row] for row in rows if row], dtype=np.float64)
    except ValueError as error:
        raise DataError(f"cannot read {path} of scene {scene}: {error}") from error
    if table.size == 0:
        raise DataError(f"{path} of scene {scene} holds no numbers")
    return table


def read_matrix(path: Path, scene: str, shapes: Sequence[tuple[int, int]]) -> NDArray[np.float64]:
    """Reads a matrix of one of the given shapes."""
    matrix = read_numbers(path, scene)
    if matrix.shape not in tuple(shapes):
        expected = " or ".join(f"{rows}x{columns}" for rows, columns in shapes)
        raise DataError(
            f"{path} of scene {scene} must hold a {expected} matrix, not {matrix.shape[0]}x{matrix.shape[1]}"
        )
    return matrix


def read_poses(files: Mapping[int, Path], scene: str) -> dict[int, NDArray[np.float64]]:
    """Reads 4x4 matrices, one per file, several at a time: on a network's disk opening one takes milliseconds."""
    numbers = list(files)

    def read(part: Sequence[int]) -> dict[int, NDArray[np.float64]]:
        return {number: read_matrix(files[number], scene, ((4, 4),)) for number in part}

    with ThreadPoolExecutor(_THREADS) as pool:
        parts = pool.map(read, [numbers[start::_THREADS] for start in range(_THREADS)])
        poses = {number: pose for part in parts for number, pose in part.items()}
    return {number: poses[number] for number in numbers}


def read_text_lines(path: Path, scene: str) -> list[str]:
    """Reads the lines of a text file without blank and ``#`` lines."""
    lines = [line.strip() for line in _read_lines(path, scene)]
    return [line for line in lines if line and not line.startswith("#")]


def _read_lines(path: Path, scene: str) -> list[str]:
    try:
        return regular(path).read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise DataError(f"cannot read {path} of scene {scene}: {error}") from error


def named_file(folder: Path, name: str, where: str) -> Path:
    """The file that a dataset's own file names, which must lie in the dataset's folder.

    The name alone is looked at: folders that are links to other disks are the user's own doing.

    Args:
        folder: the scene's folder.
        name: relative to it, or absolute.
        where: the file that names it and the scene, for the message.
    """
    root = os.path.abspath(folder)
    path = os.path.normpath(os.path.join(root, name))
    if "\0" in name or os.path.commonpath((root, path)) != root:
        raise DataError(
            f"{where} names the file {name[:200]!r}, which lies outside {folder}; move it, or a link to its folder, "
            "inside and name it relative to the folder"
        )
    return folder / os.path.relpath(path, root)


def existing_image(path: Path) -> Path | None:
    """A named image, or the one in its folder that differs in its ending or in upper and lower case; None: none.

    Models and lists often name files as they were before somebody converted them. Where the folder is missing, the
    largest reduced one is taken (``images_4`` of ``images_4`` and ``images_8``, as DL3DV comes).
    """
    if path.is_file():
        return path
    folder = path.parent
    if not folder.is_dir():
        known = sorted(folder.parent.iterdir()) if folder.parent.is_dir() else []
        reduced = [each for each in known if re.fullmatch(rf"{re.escape(folder.name)}_\d+", each.name)]
        largest = min(reduced, key=lambda each: int(each.name.rpartition("_")[2]), default=None)
        return None if largest is None else existing_image(largest / path.name)
    files = _images_by_name(path.parent, path.parent.stat().st_mtime_ns)
    name, stem = path.name.lower(), path.stem.lower()
    candidates = (name, *(name + suffix for suffix in IMAGE_SUFFIXES), *(stem + suffix for suffix in IMAGE_SUFFIXES))
    return next((files[candidate] for candidate in candidates if candidate in files), None)


@lru_cache(maxsize=16)
def _images_by_name(folder: Path, state: int) -> dict[str, Path]:
    """Images of a folder by their names in lower case; ``state`` is the folder's time of change."""
    return {path.name.lower(): path for path in sorted(folder.iterdir()) if path.suffix.lower() in IMAGE_SUFFIXES}


@contextmanager
def errors_name(scene: str) -> Iterator[None]:
    """Turns the errors of readers in ``vg2gt.io`` into ``DataError`` that also names the scene."""
    try:
        yield
    except (FormatError, OSError) as error:
        raise DataError(f"scene {scene}: {error}") from error


def numbered(folder: Path, scene: str, pattern: str = "*", suffixes: Sequence[str] = IMAGE_SUFFIXES) -> dict[int, Path]:
    """Files of a folder by the last number in their name (before the first dot), in the order of the numbers.

    Hidden files and files with other suffixes are passed over; so is a folder that does not exist.
    """
    files: dict[int, Path] = {}
    for path in sorted(folder.glob(pattern)):
        if path.name.startswith(".") or path.suffix.lower() not in suffixes:
            continue
        digits = re.findall(r"\d+", path.name.split(".")[0])
        if not digits:
            raise DataError(f"{path} of scene {scene} has no frame number in its name")
        number = int(digits[-1])
        if number in files:
            raise DataError(f"{files[number]} and {path} of scene {scene} have the same frame number {number}")
        files[number] = path
    return dict(sorted(files.items()))


def rigid(poses: NDArray[np.float64], frames: Sequence[int], where: str) -> NDArray[np.float64]:
    """Replaces the rotations of 4x4 poses, which recordings give to a few digits, by the nearest exact ones.

    Args:
        poses: ``[n, 4, 4]`` finite transforms.
        frames: their frame ids, for the message.
        where: the file or folder and the scene, for the message.
    """
    rotations = poses[:, :3, :3]
    error = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max((1, 2), initial=0)
    row = np.abs(poses[:, 3] - [0, 0, 0, 1]).max(1, initial=0)
    bad = (error > _ROTATION_TOLERANCE) | (np.linalg.det(rotations) < 0) | (row > 1e-3)
    if bad.any():
        raise DataError(
            f"the pose of frame {frames[int(bad.argmax())]} in {where} is not a rigid transform (a rotation and a "
            "translation over a row 0 0 0 1)"
        )
    left, _, right = np.linalg.svd(rotations)
    exact = np.tile(np.eye(4), (len(poses), 1, 1))
    exact[:, :3, :3] = left @ right
    exact[:, :3, 3] = poses[:, :3, 3]
    return exact


def to_world(world_to_camera: NDArray[np.float64], where: str | None = None, frame: int = 0) -> NDArray[np.float64]:
    """Inverts a pose ``[4, 4]``; one that is not finite stays so, and drops its frame.

    Args:
        world_to_camera: the pose.
        where: the file or folder and the scene: the pose is made exactly rigid first (``rigid``); None: it is rigid.
        frame: its frame id, for the message.
    """
    if not (np.abs(world_to_camera) < 1e30).all():
        return np.full((4, 4), np.nan)
    return invert_pose(rigid(world_to_camera[None], [frame], where)[0] if where else world_to_camera)


def pinhole(fx: float, fy: float, cx: float, cy: float) -> NDArray[np.float64]:
    """Intrinsics ``[3, 3]`` from focal lengths and principal point in pixels (integer pixel centres)."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def check_intrinsics(intrinsics: NDArray[np.float64], where: str) -> NDArray[np.float64]:
    """Returns ``[..., 3, 3]`` intrinsics as they are.

    Args:
        intrinsics: the matrices.
        where: the file or folder and the scene, for the message.
    """
    focal, lower = intrinsics[..., [0, 1], [0, 1]], intrinsics[..., [1, 2, 2], [0, 0, 1]]
    if not ((np.abs(intrinsics) < _LARGEST).all() and (focal > 0).all()):
        raise DataError(f"the intrinsics in {where} have no positive focal lengths: {intrinsics.tolist()}")
    small = _NO_SKEW * focal[..., 0]
    if not ((np.abs(lower) <= small[..., None]).all() and (np.abs(intrinsics[..., 2, 2] - 1) < 1e-6).all()):
        raise DataError(
            f"the intrinsics in {where} are not fx 0 cx, 0 fy cy, 0 0 1 (transposed, or another matrix?): "
            f"{_first(intrinsics)}"
        )
    if not (np.abs(intrinsics[..., 0, 1]) <= small).all():
        raise DataError(f"the intrinsics in {where} have skew, which is not modelled: {_first(intrinsics)}")
    if not (np.abs(intrinsics[..., :2, 2]) <= _FAR_OFF * focal).all():
        raise DataError(f"the principal point of the intrinsics in {where} is far outside: {_first(intrinsics)}")
    return intrinsics


def _first(matrices: NDArray[np.float64]) -> list[list[float]]:
    return matrices.reshape(-1, 3, 3)[0].tolist()


def four_intrinsics(intrinsics: Sequence[float] | None) -> tuple[float, ...] | None:
    """Checks the argument (fx, fy, cx, cy) of a loader; None stays None.

    Raises:
        ValueError: if it has another number of values.
    """
    if intrinsics is not None and len(intrinsics) != 4:
        raise ValueError(f"intrinsics must be [fx, fy, cx, cy], got {list(intrinsics)}")
    return tuple(float(value) for value in intrinsics) if intrinsics else None


def positive(name: str, value: float, unit: str) -> float:
    """Checks an argument of a loader that must be above 0.

    Raises:
        ValueError: if it is not, naming it and its unit.
    """
    if not value > 0:
        raise ValueError(f"{name} must be positive ({unit}), got {value}")
    return float(value)


def expanded(path: str | None) -> Path | None:
    """A folder that the user names, where ``~`` is the home folder."""
    return Path(path).expanduser() if path else None


def existing_depth_root(path: str | None) -> Path | None:
    """The folder of depth next to a dataset.

    Raises:
        FileNotFoundError: if it is named but does not exist.
    """
    folder = expanded(path)
    if folder is not None and not folder.is_dir():
        raise FileNotFoundError(f"the depth folder {folder} (seen from {Path.cwd()}) does not exist")
    return folder
