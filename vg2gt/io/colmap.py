"""COLMAP models, text and binary, with pycolmap (``pip install 'vg2gt[colmap]'``).

A model holds cameras, posed images and sparse points. It is a ``pycolmap.Reconstruction`` in COLMAP's conventions.
:func:`colmap_intrinsics` and :func:`colmap_from_views` shift the principal point by half a pixel: the centre of the
first pixel is (1/2, 1/2) in COLMAP and (0, 0) here. :func:`colmap_pose` and :func:`colmap_from_views` convert between
COLMAP's poses and ``world_to_camera``; both are OpenCV cameras.
"""

from __future__ import annotations

import importlib.util
import os
import re
import struct
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import PIL.Image  # noqa: F401  before pycolmap: in the other order their copies of zlib conflict
from numpy.typing import ArrayLike, NDArray

from vg2gt.io.errors import FormatError
from vg2gt.io.files import by_number, regular
from vg2gt.io.points import checked_points
from vg2gt.types import Cameras

# Types of pycolmap, which is imported only where it is needed.
Reconstruction: TypeAlias = Any
Image: TypeAlias = Any
Camera: TypeAlias = Any

PIXEL_CENTER = 0.5  # centre of the first pixel in COLMAP; ours is at 0
FILES = ("cameras", "images", "points3D")
_NOT_FINITE = re.compile(r"[+-]?(nan(\(.*\))?|inf(inity)?|1\.#\w+)", re.IGNORECASE)
_FAR = 1e30
EXTRA = "pip install 'vg2gt[colmap]'"


def require_pycolmap(purpose: str) -> None:
    """Checks early that pycolmap is installed.

    Args:
        purpose: what needs it; the error message starts with it.

    Raises:
        ImportError: if it is not installed; the message has the command that installs it.
    """
    if importlib.util.find_spec("pycolmap") is None:
        raise ImportError(f"{purpose} needs pycolmap: {EXTRA}")


def colmap_files(folder: Path) -> dict[str, Path]:
    """Finds the model's files, by the names in ``FILES``; empty if the folder holds no model.

    ``.bin`` takes precedence over ``.txt``. Case is ignored, and ``points3D`` may be missing.
    """
    found = {path.name.lower(): path for path in sorted(folder.iterdir())} if folder.is_dir() else {}
    for ending in (".bin", ".txt"):
        files = {name: found[f"{name.lower()}{ending}"] for name in FILES if f"{name.lower()}{ending}" in found}
        if "cameras" in files and "images" in files:
            return files
    return {}


def read_colmap(folder: str | Path) -> Reconstruction:
    """Reads a model; cameras may have any camera model.

    Args:
        folder: the folder with ``cameras``, ``images`` and usually ``points3D``, such as ``sparse/0``. ``rigs`` and
            ``frames`` of newer versions repeat the poses and are not read.

    Returns:
        The model. Poses and points that are not finite in the files are NaN or at least 1e30, see
        :func:`colmap_pose`. If a parameter of a camera is not finite, all its parameters are 0, see
        :func:`colmap_intrinsics`.

    Raises:
        FormatError: if there is no model, or a file is damaged, naming the file.
        ImportError: if pycolmap is not installed.
    """
    folder = Path(folder)
    files = colmap_files(folder)
    if not files:
        raise FormatError(
            f"{folder}: no COLMAP model here, expected {', '.join(FILES)} all as .bin or all as .txt; give the model's "
            "own folder, usually sparse/0"
        )
    require_pycolmap(f"reading the COLMAP model {folder}")
    import pycolmap  # pyright: ignore[reportMissingImports]

    with tempfile.TemporaryDirectory(prefix="vg2gt-colmap-") as temporary, quiet_colmap():
        for name in FILES:
            _stage(name, files.get(name), Path(temporary), files["cameras"].suffix.lower())
        try:
            model = pycolmap.Reconstruction(temporary)
        except (ValueError, IndexError, KeyError, RuntimeError, MemoryError) as error:
            raise FormatError(f"{folder}: damaged COLMAP model ({_reason(error)})") from error
    empty = [camera.camera_id for camera in model.cameras.values() if not camera.width * camera.height]
    if empty:
        raise FormatError(f"{files['cameras']}: camera {empty[0]} has images without pixels; the file is damaged")
    return model


def write_colmap(folder: str | Path, model: Reconstruction) -> Path:
    """Writes a model as ``.bin``, each file atomically.

    Args:
        folder: output folder, created if needed.
        model: model to write; not changed.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".colmap-", dir=folder) as temporary, quiet_colmap():
        model.write_binary(temporary)
        for path in sorted(Path(temporary).iterdir()):
            os.replace(path, folder / path.name)
    return folder


def colmap_images(model: Reconstruction) -> list[Image]:
    """Returns a model's images sorted by name; numbers in names sort by value (``2.jpg`` before ``10.jpg``)."""
    return sorted(model.images.values(), key=lambda image: by_number(image.name))


def colmap_intrinsics(camera: Camera) -> NDArray[np.float64]:
    """Returns a camera's pinhole intrinsics ``[3, 3]`` in pixels, with our integer pixel centres, without distortion.

    All NaN if a parameter in the file is not finite.

    Raises:
        ValueError: if the camera model has no focal length (EQUIRECTANGULAR).
    """
    if not len(camera.focal_length_idxs()):
        raise ValueError(
            f"camera {camera.camera_id}: {camera.model_name} has no pinhole equivalent; convert images to cube faces"
        )
    if not np.any(camera.params):
        return np.full((3, 3), np.nan)
    matrix = np.array(camera.calibration_matrix(), np.float64)
    matrix[:2, 2] -= PIXEL_CENTER
    return matrix


def colmap_pose(image: Image) -> NDArray[np.float64]:
    """Returns ``world_to_camera`` ``[4, 4]`` of an image; all NaN if it has no pose or a value is not finite."""
    pose = np.full((4, 4), np.nan)
    if image.has_pose:
        rigid = np.asarray(image.cam_from_world().matrix(), np.float64)
        turn = np.linalg.norm(image.cam_from_world().rotation.quat)
        if (np.abs(rigid) < _FAR).all() and turn > 0.5:
            pose = np.vstack((rigid, [0, 0, 0, 1]))
    return pose


def colmap_from_views(
    cameras: Cameras,
    names: Sequence[str],
    positions: ArrayLike | None = None,
    colors: ArrayLike | None = None,
    sources: tuple[ArrayLike, ArrayLike, ArrayLike] | None = None,
    sizes: Sequence[tuple[int, int]] | None = None,
) -> Reconstruction:
    """Builds a model from one scene's views, with one PINHOLE camera per view, numbered from 1, and points.

    Args:
        cameras: one scene (B = 1) with V views.
        names: V file names relative to the image folder.
        positions: ``[N, 3]`` world positions; None: no points.
        colors: ``[N, 3]`` uint8; None: mid grey.
        sources: T observations as point index ``[T]``, view index ``[T]`` and pixel ``[T, 2]``, (x, y) with integer
            centres; None: points have no observations.
        sizes: ``(height, width)`` of each image; None: that of the cameras.

    Raises:
        ImportError: if pycolmap is not installed.
        ValueError: if the shapes disagree.
    """
    require_pycolmap("writing a COLMAP model")
    import pycolmap  # pyright: ignore[reportMissingImports]

    poses, matrices = (t.detach().cpu().double().numpy() for t in (cameras.world_to_camera, cameras.intrinsics))
    if len(poses) != 1 or poses.shape[1] != len(names):
        raise ValueError(
            f"expected one scene with as many views as names ({len(names)}), got cameras of shape "
            f"{list(poses.shape[:2])}; use Cameras.scene"
        )
    xyz, rgb = checked_points(np.zeros((0, 3)) if positions is None else positions, colors)
    owner, view_of, pixels = _observations(sources, len(xyz), len(names))
    tracks = [pycolmap.Track() for _ in xyz]
    model = pycolmap.Reconstruction()
    for view, name in enumerate(names):
        size, k = (cameras.size if sizes is None else sizes[view]), matrices[0, view]
        params = [k[0, 0], k[1, 1], k[0, 2] + PIXEL_CENTER, k[1, 2] + PIXEL_CENTER]
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=view + 1, model="PINHOLE", width=size[1], height=size[0], params=params)
        )
        seen = np.flatnonzero(view_of == view)
        for row, observation in enumerate(seen.tolist()):
            tracks[owner[observation]].add_element(view + 1, row)
        image = pycolmap.Image(name, pixels[seen] + PIXEL_CENTER, view + 1, view + 1)
        pose = np.ascontiguousarray(poses[0, view, :3])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    for position, track, color in zip(xyz, tracks, rgb, strict=True):
        model.add_point3D(position, track, color)
    return model


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """Silences COLMAP's log."""
    import pycolmap  # pyright: ignore[reportMissingImports]

    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def _observations(sources: Any, points: int, views: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray]:
    if sources is None:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2))
    owner, view, pixels = (np.asarray(part) for part in sources)
    count = len(owner)
    inside = count == 0 or (owner.min() >= 0 and owner.max() < points and view.min() >= 0 and view.max() < views)
    if owner.shape != (count,) or view.shape != (count,) or pixels.shape != (count, 2) or not inside:
        raise ValueError(
            f"sources must be points [T] below {points}, views [T] below {views} and pixels [T, 2], got shapes "
            f"{owner.shape}, {view.shape}, {pixels.shape}"
        )
    return owner.astype(np.int64), view.astype(np.int64), pixels.astype(np.float64)


def _stage(name: str, path: Path | None, folder: Path, ending: str) -> None:
    """Checks one file and puts it, cleaned if needed, into the folder that pycolmap reads."""
    target = folder / f"{name}{ending}"
    if path is None:  # a model without points
        target.write_bytes(bytes(8) if ending == ".bin" else b"")
    elif ending == ".bin":
        data = _checked(name, path)
        if name == "cameras":
            target.write_bytes(data)
        else:
            target.symlink_to(path.resolve())
    else:
        try:
            text = regular(path).read_text(encoding="utf-8-sig")
        except UnicodeDecodeError as error:
            raise FormatError(f"{path}: not UTF-8 text ({error}); the file is damaged or not a text model") from error
        if name == "cameras" or re.search(r"(?i)[\s-](nan|inf)\b", text):
            text = "\n".join(_clean_line(name, line) for line in text.split("\n"))
        target.write_text(text, encoding="utf-8")


def _clean_line(name: str, line: str) -> str:
    """Makes a line readable by pycolmap: camera models in upper case, placeholders for values that are not finite.

    All parameters of such a camera become 0. Such images and points are moved so far away that they count as unknown.
    """
    fields = line.split(" ") if name == "images" else line.split()
    if not fields or fields[0].startswith("#"):
        return line
    spoilt = [_NOT_FINITE.fullmatch(field) is not None for field in fields]
    if name == "cameras" and len(fields) > 4:
        fields[1] = fields[1].upper()
        fields[4:] = ["0"] * len(fields[4:]) if any(spoilt[4:]) else fields[4:]
    elif name == "images" and any(spoilt):
        pose = len(fields) > 9 and re.search("[A-Za-z]", fields[9])  # the pose line, before the line of features
        fields = (
            [fields[0], "1", "0", "0", "0", *(["1e300"] * 3), *fields[8:]] if pose else _replaced(fields, spoilt, "0")
        )
    elif name == "points3D" and any(spoilt):
        fields = [*_replaced(fields[:7], spoilt, "1e300"), *_replaced(fields[7:], spoilt[7:], "-1")]
    return " ".join(fields)


def _replaced(fields: list[str], spoilt: list[bool], by: str) -> list[str]:
    return [by if bad else field for field, bad in zip(fields, spoilt, strict=False)]


def _checked(name: str, path: Path) -> bytes | bytearray:
    """Checks the record counts of a binary file, since pycolmap allocates memory for any count.

    Returns:
        The content; all parameters of a camera are set to 0 if one is not finite.

    Raises:
        FormatError: if the file ends early, or continues after its last record.
    """
    data = regular(path).read_bytes()
    if name == "cameras":
        data = bytearray(data)
    place = 8
    for number in range(_count(data, 0, path, "records")):
        if name == "cameras":
            size = 24 + 8 * _parameters(data, place + 4, path)
            params = np.frombuffer(data[place + 24 : place + size], np.uint8)
            if len(params) == size - 24 and not np.isfinite(params.view("<f8")).all():
                data[place + 24 : place + size] = bytes(size - 24)  # pyright: ignore[reportIndexIssue]
        elif name == "images":
            end = data.find(b"\0", place + 64, place + 64 + 4096)
            size = len(data) if end < 0 else end + 9 - place + 24 * _count(data, end + 1, path, "features")
        else:
            size = 51 + 8 * _count(data, place + 43, path, "observations")
        place += size
        if place > len(data):
            raise FormatError(
                f"{path}: record {number + 1} ends after the file's {len(data)} bytes; the file is truncated or damaged"
            )
    if place != len(data):
        raise FormatError(f"{path}: {len(data) - place} bytes follow the last record; the file is damaged")
    return data


def _count(data: bytes | bytearray, place: int, path: Path, what: str) -> int:
    if place + 8 > len(data):
        raise FormatError(f"{path}: ends before a number of {what} at byte {place}; the file is truncated or damaged")
    (count,) = struct.unpack_from("<Q", data, place)
    if count > len(data):
        raise FormatError(f"{path}, byte {place}: {count} {what} cannot be in {len(data)} bytes; the file is damaged")
    return count


def _parameters(data: bytes | bytearray, place: int, path: Path) -> int:
    """Number of parameters of a camera's model."""
    import pycolmap  # pyright: ignore[reportMissingImports]

    try:
        (number,) = struct.unpack_from("<i", data, place)
        return len(pycolmap.Camera.create_from_model_id(0, pycolmap.CameraModelId(number), 1.0, 1, 1).params)
    except (struct.error, ValueError, IndexError, RuntimeError) as error:
        raise FormatError(f"{path}, byte {place}: unknown camera model; the file is damaged") from error


def _reason(error: BaseException) -> str:
    text = " ".join(str(error).split()) or type(error).__name__
    return re.sub(r"^\[[\w.]+:\d+\] ", "", text)[:200]
