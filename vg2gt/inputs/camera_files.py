"""Cameras to render: read from cameras.json, transforms.json or a COLMAP model, and smooth paths through them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from vg2gt.data.sources.colmap_model import largest_of, models_in, models_of
from vg2gt.data.sources.parsing import PHOTO_SUFFIXES
from vg2gt.data.sources.undistortion import pinhole_camera
from vg2gt.inputs.folders import is_photo
from vg2gt.inputs.foreign import cameras_to_render
from vg2gt.io import colmap_images, colmap_intrinsics, colmap_pose, read_cameras_json, read_colmap, read_transforms
from vg2gt.io.cameras_json import NamedCamera, invert_pose
from vg2gt.io.colmap import colmap_files
from vg2gt.io.errors import FormatError
from vg2gt.io.files import by_number, read_json
from vg2gt.io.photogrammetry import is_camera_file


def read_cameras(path: str | Path) -> list[NamedCamera]:
    """Reads cameras from a file of any of these kinds; lens distortion is ignored.

    Args:
        path: a ``cameras.json`` of ours or of 3D Gaussian Splatting, a ``transforms.json``, a file of Metashape,
            RealityScan, Bundler or VisualSFM, a folder with a JSON file, or the folder of a COLMAP model or of a scene
            with one, of which the part with most images is read.

    Raises:
        FileNotFoundError: if the file does not exist.
        FormatError: if it is damaged or of another kind.
        ImportError: if it is a COLMAP model and pycolmap is not installed.
    """
    path = Path(path).expanduser()
    if path.is_dir():
        inside = [path / name for name in ("cameras.json", "transforms.json") if (path / name).is_file()]
        return read_cameras(inside[0]) if inside else _of_colmap(path)
    if not path.is_file():
        raise FileNotFoundError(f"no cameras at {path}")
    if is_camera_file(path):
        return cameras_to_render(path, [file for file in path.resolve().parent.rglob("*") if is_photo(file)])
    content = read_json(path)
    if isinstance(content, dict) and "frames" in content:
        return _of_transforms(path)
    return cameras_of_json(path)


def cameras_of_json(path: Path) -> list[NamedCamera]:
    """Reads a ``cameras.json`` of ours or of 3D Gaussian Splatting.

    Raises:
        FormatError: if it is damaged or of another kind.
    """
    content = read_json(path)
    if isinstance(content, list) and content and isinstance(content[0], dict) and "img_name" in content[0]:
        return [_of_3dgs(f"{path}: [{index}]", entry) for index, entry in enumerate(content)]
    return read_cameras_json(path)


def _of_colmap(folder: Path) -> list[NamedCamera]:
    split = models_of(folder) or models_of(folder / "dense") or models_in(folder)
    model = read_colmap(folder if colmap_files(folder) or not split else largest_of(split))
    cameras = []
    for image in colmap_images(model):
        lens = pinhole_camera(image.camera)
        cameras.append(NamedCamera(image.name, lens.width, lens.height, colmap_intrinsics(lens), colmap_pose(image)))
    return cameras


def _of_transforms(path: Path) -> list[NamedCamera]:
    cameras = []
    for frame in sorted(read_transforms(path).frames, key=lambda frame: by_number(frame.file_path)):
        lens = frame.lens
        if not (lens.width and lens.height):
            raise FormatError(f"{path}: {frame.file_path} has no image size (w and h), which rendering needs")
        pose = np.asarray(frame.world_to_camera, np.float64)
        if np.isfinite(pose).all():
            matrix = np.asarray(lens.intrinsics(), np.float64)
            cameras.append(NamedCamera(frame.file_path, lens.width, lens.height, matrix, pose))
    return cameras


def _of_3dgs(place: str, entry: Any) -> NamedCamera:
    """Converts an entry of 3DGS's ``cameras.json``, which has no principal point: the image centre is used."""
    try:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = entry["rotation"], entry["position"]  # camera to world
        width, height = int(entry["width"]), int(entry["height"])
        fx, fy, name = float(entry["fx"]), float(entry["fy"]), str(entry["img_name"])
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{place}: not a camera of 3D Gaussian Splatting ({error!r})") from error
    if not (np.isfinite(pose).all() and min(width, height) > 0 and min(fx, fy) > 0):
        raise FormatError(f"{place}: values that are not finite, or no positive size and focal length")
    matrix = np.array([[fx, 0, (width - 1) / 2], [0, fy, (height - 1) / 2], [0, 0, 1]])
    return NamedCamera(name, width, height, matrix, invert_pose(pose))


def interpolate(cameras: Sequence[NamedCamera], between: int) -> list[NamedCamera]:
    """Returns a smooth path through given cameras: splines of position and rotation, linear intrinsics.

    Args:
        cameras: at least two, of one image size; all are on the path.
        between: number of new cameras between neighbouring ones.

    Returns:
        The path, ``(n - 1) * (between + 1) + 1`` cameras.

    Raises:
        ValueError: if there are fewer than two cameras, their sizes differ, or ``between`` is negative.
    """
    if len(cameras) < 2 or between < 0:
        raise ValueError(f"a path needs at least two cameras and 0 or more between them, got {len(cameras)}, {between}")
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) > 1:
        raise ValueError(f"cameras of one image size are needed, these have {sorted(sizes)}; choose some of one size")
    times = np.arange(len(cameras))
    poses = np.stack([invert_pose(camera.world_to_camera) for camera in cameras])
    positions = CubicSpline(times, poses[:, :3, 3], bc_type="natural")
    rotations = RotationSpline(times, Rotation.from_matrix(poses[:, :3, :3]))
    path = [cameras[0]]
    for left, (one, other) in enumerate(itertools.pairwise(cameras)):
        for step in range(1, between + 1):
            share = step / (between + 1)
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = rotations(left + share).as_matrix(), positions(left + share)
            intrinsics = (1 - share) * one.intrinsics + share * other.intrinsics
            name = f"{view_stem(one.name)}-{step:03d}"
            path.append(NamedCamera(name, one.width, one.height, intrinsics, invert_pose(pose)))
        path.append(other)  # exactly, free of spline rounding
    return path


def view_stem(name: str) -> str:
    """Returns a view's name without an image file extension; other dots are part of the name."""
    return name[: -len(suffix)] if (suffix := Path(name).suffix).lower() in PHOTO_SUFFIXES else name
