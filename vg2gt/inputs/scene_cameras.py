"""Cameras for a scene file, moved into the scene's frame.

A reconstruction may write its scene in another frame than that of its source cameras: turned upright, or shifted from
map coordinates, which single precision cannot hold. ``report.json`` next to the scene has the similarity between them.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vg2gt.inputs.camera_files import view_stem
from vg2gt.io.cameras_json import NamedCamera, invert_pose, read_cameras_json
from vg2gt.io.errors import FormatError
from vg2gt.io.files import read_json
from vg2gt.types import Gaussians

log = logging.getLogger(__name__)

_SAME = 1e-6  # of the scene's size: a similarity that moves points less changes nothing
_ELSEWHERE = 1e3  # scene sizes between the scene and cameras that cannot see it


def cameras_of_scene(cameras: list[NamedCamera], scene: str | Path, gaussians: Gaussians) -> list[NamedCamera]:
    """Returns cameras in the frame of a scene file.

    Cameras that are in the frame of the scene's source cameras are moved into the scene's frame. Those that have the
    names of the scene's views tell their frame by their poses; others count as in the scene's frame, unless they are
    far from the scene only there.

    Args:
        cameras: cameras as read from a file (:func:`vg2gt.inputs.camera_files.read_cameras`).
        scene: scene file; ``report.json`` and ``cameras.json`` next to it are read if they exist.
        gaussians: the scene.

    Raises:
        ValueError: if they are so far from the scene that they belong to another frame.
    """
    folder = Path(scene).expanduser().parent
    if not cameras or not len(gaussians):
        return cameras
    means = gaussians.means.detach().cpu().double().numpy()
    middle = np.median(means, 0)
    size = max(float(np.median(np.linalg.norm(means - middle, axis=1))), 1e-12)
    views = _views(folder)
    to_source = _to_source(folder, views)
    moved = None if to_source is None else _moved(cameras, to_source)
    if moved is not None and _differ(cameras, moved, size) and _is_source(cameras, moved, views, middle, size):
        log.warning("the given cameras are in the frame of the source cameras and are moved into that of %s", scene)
        cameras = moved
    if (distance := _distance(cameras, middle)) > _ELSEWHERE * size:
        raise ValueError(
            f"the given cameras are {distance / size:.3g} scene sizes away from {scene}: they are in another frame "
            "(map coordinates?); give the cameras.json written with the scene, or keep its report.json next to it"
        )
    return cameras


def _views(folder: Path) -> list[NamedCamera]:
    """Returns the cameras of the scene's own views; none if they are not known."""
    try:
        return read_cameras_json(folder / "cameras.json")
    except (FormatError, OSError):
        return []


def _to_source(folder: Path, views: Sequence[NamedCamera]) -> NDArray[np.float64] | None:
    """Returns the similarity from the scene's world to that of its source cameras, if a file next to it has one."""
    file = folder / "report.json"
    report: Any = read_json(file) if file.is_file() else None
    given = report.get("to_source") if isinstance(report, dict) else None
    if given is None:
        return next((view.similarity for view in views), None)
    matrix = np.array(given, np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or np.linalg.det(matrix[:3, :3]) <= 0:
        raise FormatError(f"{file}: to_source is not a similarity transform of 4 rows of 4 numbers")
    return matrix


def _moved(cameras: Sequence[NamedCamera], to_source: NDArray[np.float64]) -> list[NamedCamera]:
    """Returns cameras of the source's world in the scene's."""
    scale = np.cbrt(np.linalg.det(to_source[:3, :3]))
    poses = [camera.world_to_camera @ to_source for camera in cameras]
    rows = np.array([[scale], [scale], [scale], [1.0]])
    return [replace(camera, world_to_camera=pose / rows) for camera, pose in zip(cameras, poses, strict=True)]


def _centers(cameras: Sequence[NamedCamera]) -> NDArray[np.float64]:
    return np.stack([invert_pose(camera.world_to_camera)[:3, 3] for camera in cameras])


def _distance(cameras: Sequence[NamedCamera], middle: NDArray[np.float64]) -> float:
    return float(np.median(np.linalg.norm(_centers(cameras) - middle, axis=1)))


def _differ(cameras: Sequence[NamedCamera], moved: Sequence[NamedCamera], size: float) -> bool:
    poses = [np.stack([camera.world_to_camera for camera in each]) for each in (cameras, moved)]
    return bool((np.abs(poses[0] - poses[1]) > _SAME * np.array([1, 1, 1, size])).any())


def _is_source(
    cameras: Sequence[NamedCamera],
    moved: Sequence[NamedCamera],
    views: Sequence[NamedCamera],
    middle: NDArray[np.float64],
    size: float,
) -> bool:
    """Returns whether cameras are in the source's frame, that is, whether ``moved`` are those of the scene."""
    known: dict[str, NamedCamera | None] = {}
    for view in views:
        for name in {_stem(view.name)} | ({_stem(view.photo.name)} if view.photo else set()):
            known[name] = None if name in known else view  # a name of two views tells nothing
    pairs = [
        (view, camera, other)
        for camera, other in zip(cameras, moved, strict=True)
        if (view := known.get(_stem(camera.name))) is not None
    ]
    if pairs:
        weight = np.array([1, 1, 1, 1 / size])  # rotations count as much as shifts by the scene's size
        own, source = (
            np.median([np.abs((p[0].world_to_camera - p[1 + k].world_to_camera) * weight).max() for p in pairs])
            for k in range(2)
        )
        return bool(source < own)
    return _distance(cameras, middle) > _ELSEWHERE * size >= _distance(moved, middle)


def _stem(name: str) -> str:
    return view_stem(Path(name).name)
