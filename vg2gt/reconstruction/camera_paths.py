"""Camera paths for videos: an orbit around the point the views look at, and smooth paths through given cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from vg2gt.data.sources.parsing import IMAGE_SUFFIXES
from vg2gt.io.cameras_json import NamedCamera, invert_pose

WIDTH, HEIGHT = 0.15, 0.06  # half axes of the orbit, as fractions of the distance to the look-at point


def orbit(cameras: Sequence[NamedCamera], distance: float, frames: int = 72) -> list[NamedCamera]:
    """Returns an elliptical path around the most central camera, always facing the point in front of it.

    With few images from one side, a wide orbit would look behind the scene; this one stays in front.

    Args:
        cameras: cameras of the views.
        distance: to the look-at point, along the central camera's axis, in scene units.
        frames: number of cameras on the path.

    Raises:
        ValueError: if there are no cameras or the numbers are not positive.
    """
    if not cameras or not distance > 0 or frames < 1:
        raise ValueError(f"an orbit needs cameras, a distance and frames, got {len(cameras)}, {distance}, {frames}")
    centers = np.stack([invert_pose(camera.world_to_camera)[:3, 3] for camera in cameras])
    middle = cameras[int(np.linalg.norm(centers - np.median(centers, 0), axis=1).argmin())]
    to_world = invert_pose(middle.world_to_camera)
    path = []
    for angle in 2 * math.pi * np.arange(frames) / frames:
        place = distance * np.array([WIDTH * math.sin(angle), -HEIGHT * math.cos(angle), 0])
        local = np.eye(4)
        local[:3, :3] = _facing(np.array([0, 0, distance]) - place)
        local[:3, 3] = place
        path.append(replace(middle, name=f"orbit-{len(path):04d}", world_to_camera=invert_pose(to_world @ local)))
    return path


LONGEST = 100_000  # maximum number of cameras on a path: about an hour of video


def interpolate(cameras: Sequence[NamedCamera], between: int) -> list[NamedCamera]:
    """Returns a smooth path through given cameras: splines of position and rotation, linear intrinsics.

    Args:
        cameras: at least two, of one image size; all are on the path.
        between: number of new cameras between neighbouring ones.

    Returns:
        The path, ``(n - 1) * (between + 1) + 1`` cameras.

    Raises:
        ValueError: if there are fewer than two cameras, their sizes differ, ``between`` is negative, or the path is
            longer than :data:`LONGEST`.
    """
    if len(cameras) < 2 or between < 0:
        raise ValueError(f"a path needs at least two cameras and 0 or more between them, got {len(cameras)}, {between}")
    if (len(cameras) - 1) * (between + 1) >= LONGEST:
        raise ValueError(f"a path of {(len(cameras) - 1) * (between + 1) + 1} cameras is longer than {LONGEST}")
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) > 1:
        raise ValueError(f"cameras of one image size are needed, these have {sorted(sizes)}; choose some of one size")
    times = np.arange(len(cameras), dtype=np.float64)
    poses = np.stack([invert_pose(camera.world_to_camera) for camera in cameras])
    positions = CubicSpline(times, poses[:, :3, 3], bc_type="natural")
    rotations = RotationSpline(times, Rotation.from_matrix(poses[:, :3, :3]))
    intrinsics = np.stack([camera.intrinsics for camera in cameras])
    path = []
    for number in range((len(cameras) - 1) * (between + 1) + 1):
        left, step = divmod(number, between + 1)
        if step == 0:  # exactly the given camera, free of spline rounding
            path.append(cameras[left])
            continue
        time = left + step / (between + 1)
        pose = np.eye(4)
        pose[:3, :3] = rotations(time).as_matrix()
        pose[:3, 3] = positions(time)
        share = time - left
        k = (1 - share) * intrinsics[left] + share * intrinsics[left + 1]
        name = f"{view_stem(cameras[left].name)}-{step:03d}"
        path.append(NamedCamera(name, cameras[0].width, cameras[0].height, k, invert_pose(pose)))
    return path


def view_stem(name: str) -> str:
    """Returns a view's name without an image file extension; other dots are part of the name."""
    return name[: -len(suffix)] if (suffix := Path(name).suffix).lower() in IMAGE_SUFFIXES else name


def _facing(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the camera-to-world rotation that looks along a direction with a level x axis (y down)."""
    forward = direction / np.linalg.norm(direction)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    return np.stack((right, np.cross(forward, right), forward), 1)
