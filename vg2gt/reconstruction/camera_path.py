"""Paths of a camera for a video: an orbit, a smooth path through cameras, or nerfstudio's ``camera_path.json``."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import splev, splprep
from scipy.spatial.transform import Rotation

from vg2gt.inputs.pictures import spread
from vg2gt.io.cameras_json import Fields, NamedCamera, check_rigid, invert_pose
from vg2gt.io.errors import FormatError
from vg2gt.io.files import read_json
from vg2gt.reconstruction.frame import upright_rotation
from vg2gt.rendering import Renderer
from vg2gt.types import Gaussians

SIZE = (720, 1280)  # default height and width
_SECONDS = {"orbit": 12.0, "swing": 8.0}
_SPEED = 0.5  # of a path through cameras: radians and median depths, each second
_LIMITS = (6.0, 60.0)  # shortest and longest default of such a path, in seconds
_FACING = math.cos(math.radians(37))  # cameras whose axis is nearer to the target look at it
_MOST = 0.8  # share of the cameras that must, for an orbit
_GAP = math.radians(120)  # larger gaps between the cameras around the target are not crossed
_SWING = math.radians(8)  # smallest angle of a swing to either side
_FLATTEST = 0.3  # smallest radius of an orbit in heights above its target
_BLOCKED = 0.5  # of the distance to the target: something this near hides it
_SMOOTH = 0.04  # root mean square deviation from cameras that are followed, in radians and median depths
_SHORTCUT = 0.7  # cameras are put in another order if that makes the path shorter by this factor
_VIEWS, _TESTED, _SIDE = 40, 24, 48  # views and frames rendered to find and test an orbit, and their longer side


@dataclass(frozen=True)
class CameraPath:
    """Cameras of the frames of a video.

    Attributes:
        cameras: one per frame, all of one size.
        fps: frames per second.
        kind: ``orbit``, ``swing`` (a part of one, to and fro), ``path`` (through cameras), ``file`` (the frames of a
            ``camera_path.json``) or ``views`` (cameras as given).
    """

    cameras: list[NamedCamera]
    fps: float
    kind: str


def resized(camera: NamedCamera, size: tuple[int, int]) -> NamedCamera:
    """Returns a camera for images of ``(height, width)`` pixels that shows an equally large part of the scene.

    With another aspect ratio it shows less in one direction and more in the other one.
    """
    height, width = size
    scale = math.sqrt(height * width / (camera.height * camera.width))
    intrinsics = camera.intrinsics.copy()
    intrinsics[:2] *= scale
    for axis, (before, after) in enumerate(((camera.width, width), (camera.height, height))):
        intrinsics[axis, 2] = scale * (camera.intrinsics[axis, 2] - (before - 1) / 2) + (after - 1) / 2
    return NamedCamera(camera.name, width, height, intrinsics, camera.world_to_camera)


def orbit(
    gaussians: Gaussians,
    cameras: Sequence[NamedCamera],
    renderer: Renderer,
    size: tuple[int, int] = SIZE,
    fps: float = 24.0,
    seconds: float | None = None,
) -> CameraPath:
    """Returns an orbit around what the cameras look at, at their median height and distance.

    The axis is the vertical of the cameras. If they are on one side only, the path swings to and fro there. If they do
    not look at one place (from inside a room), or something would hide it, the path follows the cameras.

    Args:
        gaussians: the scene, at least one Gaussian.
        cameras: cameras of its views; none: the orbit is around the middle of the Gaussians, with -y up.
        renderer: renders small images, to see where surfaces are.
        size: height and width of the frames.
        fps: frames per second.
        seconds: duration; None: 12 for an orbit, 8 for a swing, and by its length for a path.

    Raises:
        ValueError: if no camera sees anything of the scene, or ``fps`` or ``seconds`` is not positive.
    """
    known, cameras = bool(cameras), list(cameras) or _around(gaussians)
    centers, forward = _centers(cameras), np.stack([camera.world_to_camera[2, :3] for camera in cameras])
    shown, depths = _depths(gaussians, cameras, renderer)
    if not (depths > 0).any():
        raise ValueError("the cameras see nothing of the scene: are they of another scene, or in another frame?")
    points = (centers[shown] + depths[:, None] * forward[shown])[depths > 0]
    target, unit = np.median(points, axis=0), float(np.median(depths[depths > 0]))
    axis = target - centers
    facing = (axis * forward).sum(1) > _FACING * np.linalg.norm(axis, axis=1)
    if facing.mean() >= _MOST:
        down = upright_rotation(np.stack([camera.world_to_camera for camera in cameras])).T @ [0.0, 1.0, 0.0]
        poses, kind = _ring(centers[facing], target, down)
        lens = _lens(cameras, size)
        tested = [replace(lens, world_to_camera=poses(t)) for t in np.arange(_TESTED) / _TESTED]
        if not known or not any(_hidden(gaussians, camera, target, renderer) for camera in tested):
            count = _count(_SECONDS[kind] if seconds is None else seconds, fps)
            return CameraPath(
                _named([replace(lens, world_to_camera=poses(i / count)) for i in range(count)]), fps, kind
            )
    if len(cameras) == 1:
        raise ValueError("there is one camera, and something hides what it looks at: no orbit is possible")
    return glide(_in_order(cameras, unit), unit, size, fps, seconds, smooth=_SMOOTH)


def glide(
    cameras: Sequence[NamedCamera],
    unit: float,
    size: tuple[int, int] = SIZE,
    fps: float = 24.0,
    seconds: float | None = None,
    smooth: float = 0.0,
) -> CameraPath:
    """Returns a path through cameras at constant speed: splines of position, rotation and focal length.

    Args:
        cameras: at least two.
        unit: distance in the scene that counts like a turn by one radian, such as the median depth.
        size: height and width of the frames.
        fps: frames per second.
        seconds: duration; None: by the length, from 6 to 60 seconds.
        smooth: root mean square deviation from the cameras, in units and radians; 0: exactly through them.

    Raises:
        ValueError: if there are fewer than two different cameras, or ``fps`` or ``seconds`` is not positive.
    """
    values = _coordinates(cameras, unit)
    steps = np.linalg.norm(np.diff(values, axis=0), axis=1)
    kept = [0, *(np.flatnonzero(steps > 1e-6) + 1)]
    if len(kept) < 2:
        raise ValueError(f"a path needs at least two different cameras, got {len(kept)}")
    values = values[kept]
    lenses = np.stack([resized(cameras[i], size).intrinsics for i in kept])
    spline, places = splprep(values.T, s=len(kept) * smooth**2, k=min(3, len(kept) - 1))
    fine = np.linspace(0, 1, 64 * len(kept))
    curve = np.stack(splev(fine, spline), 1)
    curve[:, 3:] *= 2 / np.linalg.norm(curve[:, 3:], axis=1, keepdims=True)
    reached = np.concatenate(([0.0], np.linalg.norm(np.diff(curve, axis=0), axis=1).cumsum()))
    if seconds is None:
        seconds = float(np.clip(reached[-1] / _SPEED, *_LIMITS))
    count = _count(seconds, fps)
    frames = []
    for share in np.interp(np.linspace(0, reached[-1], count), reached, fine):
        value = np.stack(splev(share, spline))
        pose = np.eye(4)
        pose[:3, 3], pose[:3, :3] = value[:3] * unit, Rotation.from_quat(value[3:]).as_matrix()
        lens = np.eye(3)
        for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)):
            lens[row, column] = np.interp(share, places, lenses[:, row, column])
        frames.append(NamedCamera("", size[1], size[0], lens, invert_pose(pose)))
    return CameraPath(_named(frames), fps, "path")


def read_camera_path(path: str | Path, size: tuple[int, int] | None, fps: float | None) -> CameraPath | None:
    """Reads nerfstudio's ``camera_path.json``; its poses must be in the scene's frame.

    Args:
        path: the file.
        size: height and width of the frames; None: those of the file.
        fps: frames per second; None: those of the file.

    Returns:
        The path; None if the file is not of this kind.

    Raises:
        FormatError: if the file is not JSON or a field is wrong; the message names it.
    """
    path = Path(path)
    content: Any = read_json(path)
    if not (isinstance(content, dict) and "camera_path" in content):
        return None
    top = Fields(f"{path}: ", content)
    if content.get("camera_type", "perspective") != "perspective":
        raise top.wrong("camera_type", "perspective, the only kind that is rendered")
    if size is None:
        size = top.pixels("render_height") or SIZE[0], top.pixels("render_width") or SIZE[1]
    entries = top.get("camera_path", list, "a list of cameras", required=True)
    if not entries:
        raise FormatError(f"{path}: camera_path is empty; add key frames in the viewer that wrote it")
    cameras = [_of_nerfstudio(Fields(f"{path}: camera_path[{i}].", entry), size) for i, entry in enumerate(entries)]
    return CameraPath(_named(cameras), fps or top.number("fps", 0, 1000) or 24.0, "file")


def _of_nerfstudio(fields: Fields, size: tuple[int, int]) -> NamedCamera:
    """Reads one frame: a pose of 16 numbers in OpenGL's axes, and the vertical field of view in degrees."""
    fov = fields.number("fov", 0, 180)
    numbers = fields.content.get("camera_to_world")
    if fov is None:
        raise fields.wrong("fov", "the vertical field of view in degrees")
    if not (isinstance(numbers, list) and len(numbers) == 16 and all(type(n) in (int, float) for n in numbers)):
        raise fields.wrong("camera_to_world", "16 numbers")
    pose = np.array(numbers, np.float64).reshape(4, 4)
    if not np.isfinite(pose).all():
        raise fields.wrong("camera_to_world", "16 finite numbers")
    check_rigid(f"{fields.place}camera_to_world", pose, 1e-3)
    height, width = size
    focal = height / 2 / math.tan(math.radians(fov) / 2)
    intrinsics = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return NamedCamera("", width, height, intrinsics, invert_pose(pose * [1, -1, -1, 1]))


def median_depth(gaussians: Gaussians, cameras: Sequence[NamedCamera], renderer: Renderer) -> float:
    """Returns the median depth of what cameras see, in scene units; 0: they see nothing."""
    _, depths = _depths(gaussians, cameras, renderer)
    return float(np.median(depths[depths > 0])) if (depths > 0).any() else 0.0


def _depths(
    gaussians: Gaussians, cameras: Sequence[NamedCamera], renderer: Renderer
) -> tuple[list[int], NDArray[np.float64]]:
    """Returns positions of evenly spread cameras, and the depth in the middle of each."""
    shown = spread(len(cameras), min(len(cameras), _VIEWS))
    return shown, np.array([_middle_depth(gaussians, cameras[i], renderer) for i in shown])


@torch.no_grad()
def _middle_depth(gaussians: Gaussians, camera: NamedCamera, renderer: Renderer) -> float:
    """Returns the median depth of the middle third of what a camera sees, in scene units; 0: it sees nothing there."""
    scale = _SIDE / max(camera.width, camera.height)
    small = resized(camera, (max(3, round(scale * camera.height)), max(3, round(scale * camera.width))))
    depth = renderer(gaussians, small.cameras().to(gaussians.means.device)).depth[0, 0].cpu()
    height, width = depth.shape
    middle = depth[height // 3 : height - height // 3, width // 3 : width - width // 3]
    return float(middle[middle > 0].median()) if (middle > 0).float().mean() > 0.5 else 0.0


def _hidden(gaussians: Gaussians, camera: NamedCamera, target: NDArray[np.float64], renderer: Renderer) -> bool:
    distance = float(np.linalg.norm(_centers([camera])[0] - target))
    return 0 < _middle_depth(gaussians, camera, renderer) < _BLOCKED * distance


def _ring(
    centers: NDArray[np.float64], target: NDArray[np.float64], down: NDArray[np.float64]
) -> tuple[Callable[[float], NDArray[np.float64]], str]:
    """Returns the poses of an orbit as a function of the share of it that is done, and its kind."""
    offsets = centers - target
    height = float(np.median(offsets @ -down))
    flat = offsets - np.outer(offsets @ down, down)
    radius = max(float(np.median(np.linalg.norm(flat, axis=1))), _FLATTEST * abs(height))
    ahead = flat[np.linalg.norm(flat, axis=1).argmax()]
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-12) if ahead.any() else _perpendicular(down)
    sideways = np.cross(down, ahead)
    angles = np.sort(np.arctan2(flat @ sideways, flat @ ahead))
    gaps = np.diff(np.append(angles, angles[0] + 2 * math.pi))
    widest = int(gaps.argmax())
    covered = 2 * math.pi - float(gaps[widest])
    middle = float(angles[(widest + 1) % len(angles)]) + covered / 2
    whole = gaps[widest] <= _GAP

    def pose(share: float) -> NDArray[np.float64]:
        turn = 2 * math.pi * share
        angle = angles[0] + turn if whole else middle + max(covered / 2, _SWING) * math.sin(turn)
        place = target - height * down + radius * (math.cos(angle) * ahead + math.sin(angle) * sideways)
        return look_at(place, target, down)

    return pose, "orbit" if whole else "swing"


def look_at(center: NDArray[np.float64], target: NDArray[np.float64], down: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the pose ``[4, 4]`` ``world_to_camera`` of a level camera at ``center`` that looks at ``target``."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(down, forward)
    if np.linalg.norm(right) < 1e-6:
        right = _perpendicular(forward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = right, np.cross(forward, right), forward
    pose[:3, 3] = -pose[:3, :3] @ center
    return pose


def _perpendicular(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    found = np.asarray(np.cross(vector, np.eye(3)[np.abs(vector).argmin()]), np.float64)
    return found / float(np.linalg.norm(found))


def _around(gaussians: Gaussians) -> list[NamedCamera]:
    """Returns cameras around the middle of the Gaussians, 20 degrees above it, with -y up."""
    means = gaussians.means.detach().cpu().double().numpy()
    target = np.median(means, axis=0)
    distance = 3 * max(float(np.median(np.linalg.norm(means - target, axis=1))), 1e-6)
    lens, down, found = np.array([[800.0, 0, 479.5], [0, 800, 359.5], [0, 0, 1]]), np.array([0.0, 1, 0]), []
    for angle in np.arange(8) * math.pi / 4:
        center = target + distance * np.array([0.94 * math.sin(angle), -0.34, -0.94 * math.cos(angle)])
        found.append(NamedCamera("", 960, 720, lens, look_at(center, target, down)))
    return found


def _in_order(cameras: Sequence[NamedCamera], unit: float) -> list[NamedCamera]:
    """Returns the cameras as given, or each followed by its nearest if that makes the path much shorter."""
    values = _coordinates(cameras, unit)
    order, rest = [0], set(range(1, len(cameras)))
    while rest:
        last = values[order[-1]]
        order.append(min(rest, key=lambda i: float(np.abs(values[i] - last).sum())))
        rest.remove(order[-1])
    length, shorter = (np.linalg.norm(np.diff(v, axis=0), axis=1).sum() for v in (values, values[order]))
    return [cameras[i] for i in order] if shorter < _SHORTCUT * length else list(cameras)


def _coordinates(cameras: Sequence[NamedCamera], unit: float) -> NDArray[np.float64]:
    """Returns ``[N, 7]``: positions in units, and quaternions of length 2, whose distance is about the angle."""
    poses = invert_pose(np.stack([camera.world_to_camera for camera in cameras]))
    quats = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    flips = np.where((quats[1:] * quats[:-1]).sum(1) < 0, -1.0, 1.0)
    quats[1:] *= np.cumprod(flips)[:, None]
    return np.concatenate((poses[:, :3, 3] / unit, 2 * quats), axis=1)


def _centers(cameras: Sequence[NamedCamera]) -> NDArray[np.float64]:
    return np.stack([invert_pose(camera.world_to_camera)[:3, 3] for camera in cameras])


def _lens(cameras: Sequence[NamedCamera], size: tuple[int, int]) -> NamedCamera:
    """Returns a camera of the median focal length with a centred principal point."""
    height, width = size
    focal = float(np.median([resized(camera, size).intrinsics[[0, 1], [0, 1]].mean() for camera in cameras]))
    intrinsics = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return NamedCamera("", width, height, intrinsics, np.eye(4))


def _count(seconds: float, fps: float) -> int:
    if not (0 < seconds < 36_000 and 0 < fps <= 1000):
        raise ValueError(f"seconds and fps must be positive and reasonable, got {seconds:g} and {fps:g}")
    return max(2, round(seconds * fps))


def _named(cameras: Sequence[NamedCamera]) -> list[NamedCamera]:
    return [replace(camera, name=f"frame-{number:05d}") for number, camera in enumerate(cameras)]
