"""Exports of iPhone and iPad capture apps: Record3D, Polycam, Stray Scanner.

The app is detected from the files present:

* Record3D's ``.r3d``, packed or unpacked: ``metadata``, ``rgbd/N.jpg``, ``rgbd/N.depth`` (metres), ``rgbd/N.conf``;
* Polycam, *raw data*: ``keyframes/images/N.jpg``, ``keyframes/cameras/N.json``, ``keyframes/depth/N.png`` (mm); with
  optimised cameras, ``corrected_images/`` and ``corrected_cameras/``;
* Stray Scanner: ``rgb.mp4``, ``depth/N.png`` (mm), ``odometry.csv``, ``camera_matrix.csv``.

All are metric. Depth has a lower resolution than colour; ``confidence/N.png`` or ``N.conf`` is 0 where depth is
unreliable. Principal points are measured from the image corner, as in ARKit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vg2gt.data.sources.parsing import CORNER_TO_CENTER, errors_name, numbered, pinhole, pose_matrices
from vg2gt.io.errors import FormatError
from vg2gt.io.files import read_json
from vg2gt.io.image_files import Size, image_size
from vg2gt.io.record3d import is_archive, read_recorded, recorded_files, unpack_lzfse
from vg2gt.io.video import video_size

PACKED = ".depth"
"""Suffix of depth files that store compressed floats in metres."""
VIDEO = "rgb.mp4"
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # from ARKit's camera axes to OpenCV's


@dataclass(frozen=True)
class Recording:
    """Files and cameras of a recording, by frame number.

    Attributes:
        color: colour image files; for Stray Scanner always the video.
        depth: depth files.
        poses: ``[4, 4]`` camera-to-world, OpenCV, metres.
        intrinsics: ``[3, 3]`` of the colour images, integer pixel centres.
        color_size: ``(height, width)`` of the colour images.
        depth_size: ``(height, width)`` of the depth; None: that of its first file.
    """

    color: Mapping[int, Path]
    depth: Mapping[int, Path]
    poses: Mapping[int, NDArray[np.float64]]
    intrinsics: Mapping[int, NDArray[np.float64]]
    color_size: Size
    depth_size: Size | None = None


def app_of(folder: Path) -> Callable[[Path, str], Recording] | None:
    """Returns the reader for the app that exported a folder or archive; None if it is no such export.

    The reader takes the folder and the scene's name. It raises ``FormatError`` or ``DataError`` if the export is
    damaged, and ``ImportError`` if a required package is not installed, such as PyAV for videos.
    """
    if is_archive(folder) or ((folder / "metadata").is_file() and (folder / "rgbd").is_dir()):
        return _read_record3d
    if (folder / "keyframes" / "cameras").is_dir():
        return _read_polycam
    return _read_stray if (folder / "odometry.csv").is_file() and (folder / VIDEO).is_file() else None


def read_metres(path: Path, scene: str, size: Size) -> NDArray[np.float32]:
    """Reads a ``PACKED`` depth file ``[H, W]``; 0 where depth is invalid or the confidence in its ``.conf`` is 0.

    Raises:
        DataError: if the file is missing, damaged or of another size.
        ImportError: if a required package is not installed.
    """
    with errors_name(scene):
        depth = _unpacked(path, np.dtype("<f4"), size)
        with suppress(FileNotFoundError):
            depth = np.where(_unpacked(path.with_suffix(".conf"), np.dtype(np.uint8), size) > 0, depth, 0)
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)


def _unpacked(path: Path, kind: np.dtype[Any], size: Size) -> NDArray[Any]:
    content = unpack_lzfse(path)
    expected = kind.itemsize * size[0] * size[1]
    if len(content) != expected:
        raise FormatError(f"{path} unpacks to {len(content)} bytes, expected {expected}; export the recording again")
    return np.frombuffer(content, kind).reshape(size)


def _read_record3d(recording: Path, scene: str) -> Recording:
    """Reads a ``.r3d``: ``poses`` as qx qy qz qw x y z; column-major ``K``, or coefficients per frame."""
    path = recording / "metadata"
    content = read_json(path, read_recorded(path))
    color, depth = recorded_files(recording, ".jpg"), recorded_files(recording, PACKED)
    first = next(iter(color.values()), None)
    size = image_size(first, scene, content=read_recorded(first)) if first else (0, 0)
    height, width = _numbers(path, content, "h", "w")
    recorded = _numbers(path, content, "dh", "dw").astype(int).tolist()
    if first and (recorded[0] > size[0] or not np.isclose(height * size[1], width * size[0], rtol=0.02)):
        raise FormatError(
            f"{path} gives images of {width:g}x{height:g} pixels and depth of {recorded[1]}x{recorded[0]}, but the "
            f"images are {size[1]}x{size[0]}"
        )
    try:
        rows = np.asarray(content["poses"], np.float64).reshape(-1, 7)
        if coefficients := content.get("perFrameIntrinsicCoeffs"):
            cameras = [pinhole(*row) for row in np.asarray(coefficients, np.float64).reshape(len(rows), 4)]
        else:
            cameras = [np.asarray(content["K"], np.float64).reshape(3, 3).T] * len(rows)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise FormatError(f"{path}: expected poses and intrinsics as Record3D writes them ({error})") from error
    scale = np.diag([size[1] / width, size[0] / height, 1.0])
    return Recording(
        color,
        depth,
        poses={i: pose @ _OPENGL for i, pose in enumerate(pose_matrices(rows[:, [4, 5, 6, 0, 1, 2, 3]]))},
        intrinsics={i: scale @ camera - CORNER_TO_CENTER for i, camera in enumerate(cameras)},
        color_size=size,
        depth_size=(recorded[0], recorded[1]),
    )


def _read_polycam(folder: Path, scene: str) -> Recording:
    """Reads one file per camera, with ``fx fy cx cy width height`` and the pose rows ``t_00`` to ``t_23``."""
    inside = folder / "keyframes"
    corrected = (inside / "corrected_cameras").is_dir() and (inside / "corrected_images").is_dir()
    before = "corrected_" if corrected else ""
    color, depth = numbered(inside / f"{before}images", scene), numbered(inside / "depth", scene)
    size = image_size(next(iter(color.values())), scene) if color else (0, 0)
    poses, intrinsics = {}, {}
    for frame, path in numbered(inside / f"{before}cameras", scene, suffixes=(".json",)).items():
        content = read_json(path)
        rows = _numbers(path, content, *(f"t_{row}{column}" for row in range(3) for column in range(4)))
        poses[frame] = np.vstack((rows.reshape(3, 4), [0, 0, 0, 1])) @ _OPENGL
        width, height = _numbers(path, content, "width", "height")
        camera = pinhole(*_numbers(path, content, "fx", "fy", "cx", "cy"))
        intrinsics[frame] = np.diag([size[1] / width, size[0] / height, 1.0]) @ camera - CORNER_TO_CENTER
    return Recording(color, depth, poses, intrinsics, size)


def _read_stray(folder: Path, scene: str) -> Recording:
    """Reads ``odometry.csv``: a header, then timestamp, frame, x, y, z, qx, qy, qz, qw of OpenCV cameras."""
    path = folder / "odometry.csv"
    try:
        rows = np.loadtxt(path, delimiter=",", skiprows=1, usecols=range(1, 9), ndmin=2)
        matrix = np.loadtxt(folder / "camera_matrix.csv", delimiter=",").reshape(3, 3)
    except (ValueError, IndexError) as error:  # UnicodeDecodeError is a ValueError
        raise FormatError(f"{path} or camera_matrix.csv next to it is damaged: {error}") from error
    if not len(rows) or not (np.abs(rows[:, 0]) < 2**31).all():
        raise FormatError(f"{path} has no frames, or invalid frame numbers")
    frames = rows[:, 0].astype(int).tolist()
    return Recording(
        dict.fromkeys(frames, folder / VIDEO),
        numbered(folder / "depth", scene),
        dict(zip(frames, pose_matrices(rows[:, 1:]), strict=True)),
        dict.fromkeys(frames, matrix - CORNER_TO_CENTER),
        video_size(folder / VIDEO),
    )


def _numbers(path: Path, content: Any, *names: str) -> NDArray[np.float64]:
    """Returns the finite numbers of a JSON object under the given names; two names are a size, at least 1."""
    found = [content.get(name) if isinstance(content, dict) else None for name in names]
    numbers = [float(value) for value in found if isinstance(value, (int, float)) and abs(value) < 1e9]
    if len(numbers) < len(names) or (len(names) == 2 and min(numbers) < 1):
        raise FormatError(f"{path}: expected numbers {', '.join(names)}")
    return np.array(numbers)
