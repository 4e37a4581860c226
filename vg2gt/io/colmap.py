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
_NOT_FINITE = re.compile(r"[\s-](nan|inf)\b", re.IGNORECASE)
_FAR = 1e30  # larger values are as senseless as those that are not finite
_EXTRA = "pip install 'vg2gt[colmap]'"


def require_pycolmap(purpose: str, otherwise: str = "") -> None:
    """Checks early that pycolmap is installed.

    Args:
        purpose: what needs it; the error message starts with it.
        otherwise: what to do instead; the message ends with it.

    Raises:
        ImportError: if it is not installed; the message has the command that installs it.
    """
    if importlib.util.find_spec("pycolmap") is None:
        remedy = f"{_EXTRA}; {otherwise}" if otherwise else _EXTRA
        raise ImportError(f"{purpose} needs pycolmap: {remedy}")


def colmap_files(folder: Path) -> dict[str, Path]:
    """Finds the model's files, by the names in ``FILES``; empty if the folder holds no model.

    ``.bin`` takes precedence over ``.txt``. ``points3D`` may be missing.
    """
    for ending in (".bin", ".txt"):
        files = {name: path for name in FILES if (path := folder / f"{name}{ending}").exists()}
        if "cameras" in files and "images" in files:
            return files
    return {}


def read_colmap(folder: str | Path) -> Reconstruction:
    """Reads a model; cameras may have any camera model.

    Args:
        folder: the folder with ``cameras``, ``images`` and usually ``points3D``, such as ``sparse/0``. ``rigs`` and
            ``frames`` of newer versions repeat the poses and are not read.

    Returns:
        The model.

    Raises:
        FormatError: if there is no model, or a file is damaged or has values that are not finite, naming the file.
        ImportError: if pycolmap is not installed.
    """
    folder = Path(folder)
    files = colmap_files(folder)
    if not files:
        kinds = f"{', '.join(FILES)} all as .bin or all as .txt"
        raise FormatError(f"{folder}: no COLMAP model here, expected {kinds}; its folder is usually sparse/0")
    require_pycolmap(f"reading the COLMAP model {folder}")
    import pycolmap  # pyright: ignore[reportMissingImports]

    ending = files["cameras"].suffix
    with tempfile.TemporaryDirectory(prefix="vg2gt-colmap-") as temporary, quiet_colmap():
        for name in FILES:
            target = Path(temporary, f"{name}{ending}")
            if name not in files:
                target.write_bytes(bytes(8) if ending == ".bin" else b"")  # no points
                continue
            target.symlink_to(regular(files[name]).resolve())
            if ending == ".bin":
                _check_records(name, files[name])
        try:
            model = pycolmap.Reconstruction(temporary)
            if ending == ".txt":
                _restore_names(model, files["images"])
            senseless = _senseless(model)
        except (ValueError, IndexError, KeyError, RuntimeError, MemoryError) as error:
            texts = {path: path.read_text(errors="replace") for path in files.values() if path.suffix == ".txt"}
            not_finite = [path for path, text in texts.items() if _NOT_FINITE.search(text)]
            where = f"{not_finite[0]}: values that are not finite" if not_finite else f"{folder}: damaged COLMAP model"
            raise FormatError(f"{where} ({' '.join(str(error).split())[:200]})") from error
    for name, numbers in senseless.items():
        if numbers:
            what = f"number {numbers[0]} has values that are not finite or make no sense"
            raise FormatError(f"{files[name]}: {what}; correct or remove it, or export the model again")
    return model


def count_images(folder: Path) -> int:
    """Returns the number of images of the model in a folder, without reading it; 0 if it is missing or damaged."""
    file = colmap_files(folder).get("images")
    if file is None:
        return 0
    if file.suffix == ".txt":
        return sum(1 for _ in _image_lines(file))
    with regular(file).open("rb") as opened:
        head = opened.read(8)
    return struct.unpack("<Q", head)[0] if len(head) == 8 else 0


def _image_lines(file: Path) -> Iterator[str]:
    """Yields the first of the two lines of every image in ``images.txt``."""
    lines = iter(file.read_text(errors="replace").split("\n"))
    for line in map(str.strip, lines):
        if line and not line.startswith("#"):
            yield line
            next(lines, None)  # its points


def _restore_names(model: Reconstruction, file: Path) -> None:
    """Sets the names of images from ``images.txt``; pycolmap's reader ends them at the first space."""
    for line in _image_lines(file):
        number, *_, name = line.split(maxsplit=9)
        if int(number) in model.images:
            model.images[int(number)].name = name


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

    Raises:
        ValueError: if the camera model has no focal length (EQUIRECTANGULAR).
    """
    if not len(camera.focal_length_idxs()):
        raise ValueError(f"{camera.model_name} has no pinhole equivalent; convert images to cube faces")
    matrix = np.array(camera.calibration_matrix(), np.float64)
    matrix[:2, 2] -= PIXEL_CENTER
    return matrix


def colmap_pose(image: Image) -> NDArray[np.float64]:
    """Returns ``world_to_camera`` ``[4, 4]`` of an image."""
    return np.vstack((image.cam_from_world().matrix(), [0, 0, 0, 1]))


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
    nothing = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2))
    owner, view_of, pixels = (np.asarray(part) for part in sources or nothing)
    if view_of.shape != owner.shape or pixels.shape != (len(owner), 2):
        raise ValueError(f"sources must be [T], [T] and [T, 2], got {owner.shape}, {view_of.shape}, {pixels.shape}")
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


def _senseless(model: Reconstruction) -> dict[str, list[int]]:
    """Numbers of the cameras, images and points whose values are not finite or make no sense, by file."""

    def sound(values: Any) -> bool:
        return bool((np.abs(values) < _FAR).all())

    poses = {number: image.cam_from_world() for number, image in model.images.items() if image.name}
    posed = {n for n, pose in poses.items() if sound(pose.matrix()) and np.linalg.norm(pose.rotation.quat) > 0.5}
    return {
        "cameras": [n for n, c in model.cameras.items() if not (c.width * c.height and sound(c.params))],
        "images": [number for number in model.images if number not in posed],
        "points3D": [number for number, point in model.points3D.items() if not sound(point.xyz)],
    }


def _check_records(name: str, path: Path) -> None:
    """Checks that the records of a binary file fill it: pycolmap would read on and allocate memory without bound.

    Raises:
        FormatError: if they do not.
    """
    import pycolmap  # pyright: ignore[reportMissingImports]

    data = path.read_bytes()

    def count(place: int, kind: str = "<Q") -> int:
        return struct.unpack_from(kind, data, place)[0]

    place = 8
    try:
        for _ in range(count(0)):
            if name == "cameras":
                model = pycolmap.CameraModelId(count(place + 4, "<i"))
                place += 24 + 8 * len(pycolmap.Camera.create_from_model_id(0, model, 1.0, 1, 1).params)
            elif name == "images":
                end = data.index(b"\0", place + 64) + 1  # of the name
                place = end + 8 + 24 * count(end)
            else:
                place += 51 + 8 * count(place + 43)
    except (struct.error, ValueError, ArithmeticError, LookupError, RuntimeError):
        place = -1
    if place != len(data):
        raise FormatError(f"{path}: its records do not fill its {len(data)} bytes; the file is truncated or damaged")
