"""Readers and checks shared by all loaders.

They raise ``DataError`` if a file is missing, damaged or has unexpected contents; the message names the file and the
scene.
"""

from __future__ import annotations

import codecs
import glob
import os
import re
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vg2gt.data.base import DataError
from vg2gt.io.errors import FormatError
from vg2gt.io.files import by_number, regular

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".tif", ".tiff", ".webp", ".bmp")
PHOTO_SUFFIXES = (*IMAGE_SUFFIXES, ".heic", ".heif", ".avif", ".jfif", ".jpe")
IMAGE_FOLDERS = ("images", "color", "rgb", "image", "input")
MASK_FOLDERS = re.compile(r"(.*[._ -])?masks?([._ -].*)?|segmentations?|silhouettes?", re.IGNORECASE)
"""Names of folders that hold masks; only ``masks`` and ``mask`` are used."""
OTHER_FOLDERS = re.compile(
    rf"{MASK_FOLDERS.pattern}|[._@].*|depths?|depth[_-].*|.*[_-]depths?|normals?|conf(idence)?|sparse|dense|stereo|semantics?|labels?|"
    r"thumb(nail)?s?|images_\d+",
    re.IGNORECASE,
)
"""Names of folders that hold other things than photographs, or reduced copies of them."""

CORNER_TO_CENTER = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
"""Subtract it from intrinsics to move their origin from the corner of the first pixel to its centre."""

_THREADS = 8
_ROTATION_TOLERANCE = 0.02
_FAR_OFF = 50.0  # limit of the principal point, in focal lengths
_NO_SKEW = 1e-3  # tolerance, as a fraction of the focal length: half a pixel at the border of an image
_LARGEST = float(np.finfo(np.float32).max)


def read_numbers(path: Path, scene: str) -> NDArray[np.float64]:
    """Reads a table of numbers with at least one row; ``#`` starts a comment."""
    rows = [line.split("#")[0].split() for line in _read_lines(path, scene)]
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
    """Reads one 4x4 matrix per file, in parallel, because opening a file on a network disk takes milliseconds."""
    with ThreadPoolExecutor(_THREADS) as pool:
        poses = pool.map(lambda path: read_matrix(path, scene, ((4, 4),)), files.values())
        return dict(zip(files, poses, strict=True))


def pose_matrices(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Converts rows to poses ``[n, 4, 4]``: a 4x4 or 3x4 matrix, or x y z qx qy qz qw, optionally after a timestamp.

    An invalid quaternion gives a pose of NaN.
    """
    count = rows.shape[1]
    if count == 16:
        return rows.reshape(-1, 4, 4)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    if count == 12:
        poses[:, :3] = rows.reshape(-1, 3, 4)
        return poses
    numbers = rows[:, -7:]
    good = np.isfinite(numbers).all(1) & (np.linalg.norm(numbers[:, 3:], axis=1) > 0.5)
    poses[~good] = np.nan
    poses[good, :3, :3] = Rotation.from_quat(numbers[good, 3:]).as_matrix()
    poses[good, :3, 3] = numbers[good, :3]
    return poses


def read_text_lines(path: Path, scene: str) -> list[str]:
    """Reads the lines of a text file; skips blank and ``#`` lines."""
    lines = [line.strip() for line in _read_lines(path, scene)]
    return [line for line in lines if line and not line.startswith("#")]


def _read_lines(path: Path, scene: str) -> list[str]:
    try:
        content = regular(path).read_bytes()
        marked = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))  # as PowerShell writes text
        return content.decode("utf-16" if marked else "utf-8-sig").splitlines()
    except (OSError, ValueError) as error:
        raise DataError(f"cannot read {path} of scene {scene}: {error}") from error


def named_file(folder: Path, name: str, where: str) -> Path:
    """Resolves a file name found in a dataset file; it must lie inside the scene's folder.

    Only the name is checked: symbolic links to other disks are allowed.

    Args:
        folder: the scene's folder.
        name: file name, relative to the folder or absolute.
        where: the file that contains the name and the scene, for the message.
    """
    root = os.path.abspath(folder)
    path = os.path.normpath(os.path.join(root, name))
    if "\0" in name or os.path.commonpath((root, path)) != root:
        raise DataError(
            f"{where} names the file {name[:200]!r}, which lies outside {folder}; move it, or a link to its folder, "
            "inside and name it relative to the folder"
        )
    return folder / os.path.relpath(path, root)


def is_image_folder(name: str) -> bool:
    """Returns whether a folder has a name of images (``images``, ``color``, ...) or of reduced ones (``images_4``)."""
    return re.fullmatch(rf"{'|'.join(IMAGE_FOLDERS)}|images_\d+", name, re.IGNORECASE) is not None


def existing_image(path: Path) -> Path | None:
    """Finds an image by its path, or by its name with another or an additional suffix; None if there is none.

    Models and lists often contain file names from before a conversion. If the folder ``images`` or the like is
    missing, the least downsampled copy of it is used (``images_4`` rather than ``images_8``, as in DL3DV).
    """
    if path.is_file():
        return path
    folder, forms = path.parent, [unicodedata.normalize(form, str(path)) for form in ("NFC", "NFD")]
    if not path.name.isascii() or not folder.is_dir():  # macOS decomposes umlauts, others do not
        same = [each for form in forms for each in (folder / Path(form).name, Path(form))]
        if found := next((each for each in same if each.is_file()), None):
            return found
    if not folder.is_dir() and folder.name in IMAGE_FOLDERS:  # others, such as cam_1, are cameras of a rig
        reduced = folder.parent.glob(f"{glob.escape(folder.name)}_[0-9]*")
        largest = min(reduced, key=lambda each: by_number(each.name), default=None)
        return None if largest is None else existing_image(largest / path.name)
    endings = [ending for suffix in IMAGE_SUFFIXES for ending in (suffix, suffix.upper())]
    candidates = (folder / (stem + ending) for stem in (path.name, path.stem) for ending in endings)
    return next((candidate for candidate in candidates if candidate.is_file()), None)


@contextmanager
def errors_name(scene: str) -> Iterator[None]:
    """Converts the errors of readers in ``vg2gt.io`` to ``DataError`` with the scene's name."""
    try:
        yield
    except (FormatError, OSError) as error:
        raise DataError(f"scene {scene}: {error}") from error


def numbered(folder: Path, scene: str, pattern: str = "*", suffixes: Sequence[str] = IMAGE_SUFFIXES) -> dict[int, Path]:
    """Returns the files of a folder by the last number in their name (before the first dot), in increasing order.

    Hidden files and files with other suffixes are skipped. A missing folder gives an empty result.
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
    """Projects the rotations of 4x4 poses, which files store with few digits, to the nearest exact rotations.

    Args:
        poses: ``[n, 4, 4]`` finite transforms.
        frames: frame ids of the poses, for the message.
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


def pinhole(fx: float, fy: float, cx: float, cy: float) -> NDArray[np.float64]:
    """Returns intrinsics ``[3, 3]`` from focal lengths and principal point in pixels (integer pixel centres)."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def check_intrinsics(intrinsics: NDArray[np.float64], where: str) -> NDArray[np.float64]:
    """Checks that intrinsics are finite pinhole matrices without skew and returns them unchanged.

    Args:
        intrinsics: ``[..., 3, 3]`` matrices.
        where: the file or folder and the scene, for the message.
    """
    focal, zeros = intrinsics[..., [0, 1], [0, 1]], intrinsics[..., [0, 1, 2, 2], [1, 0, 0, 1]]
    first = intrinsics.reshape(-1, 3, 3)[0].tolist()
    if not ((np.abs(intrinsics) < _LARGEST).all() and (focal > 0).all()):
        raise DataError(f"the intrinsics in {where} have no positive focal lengths: {first}")
    is_pinhole = (np.abs(zeros) <= _NO_SKEW * focal[..., :1]).all() and (np.abs(intrinsics[..., 2, 2] - 1) < 1e-6).all()
    if not (is_pinhole and (np.abs(intrinsics[..., :2, 2]) <= _FAR_OFF * focal).all()):
        raise DataError(
            f"the intrinsics in {where} are not fx 0 cx, 0 fy cy, 0 0 1 (transposed, with skew, which is not modelled, "
            f"or a principal point far outside?): {first}"
        )
    return intrinsics


def four_intrinsics(intrinsics: Sequence[float] | None) -> tuple[float, ...] | None:
    """Checks the argument (fx, fy, cx, cy) of a loader; returns None for None.

    Raises:
        ValueError: if it does not have four values.
    """
    if intrinsics is not None and len(intrinsics) != 4:
        raise ValueError(f"intrinsics must be [fx, fy, cx, cy], got {list(intrinsics)}")
    return None if intrinsics is None else tuple(map(float, intrinsics))


def expanded(path: str | None) -> Path | None:
    """Returns a path with ``~`` expanded; None for an empty one."""
    return Path(path).expanduser() if path else None
