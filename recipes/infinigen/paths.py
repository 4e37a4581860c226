"""Camera paths through a room that imitate handheld photography: walks, turns, orbits, near and far views.

Paths ask a room, such as ``views.Room``, for free space and visibility, so they do not need Blender: ``low`` and
``high``, the corners of its bounding box ``[3]``; ``objects``, centre and radius of what to look at ``[n, 4]``;
``inside(point)``; and ``cast(origin, direction)``. World: z up, metres.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

_SIDES = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], np.float64)
_SIDES /= np.linalg.norm(_SIDES, axis=1, keepdims=True)
_MARGIN = 0.22  # free space around a camera in metres
_TRIES = 60
SHARES = {"walk": 12, "turn": 8, "orbit_near": 12, "orbit_far": 12, "near": 8, "far": 8}
"""Number of views per kind of path, out of 60."""


@dataclass(frozen=True)
class View:
    """A camera.

    Attributes:
        path: kind and number of its path, such as ``walk_0``.
        position: ``[3]``.
        forward: unit viewing direction ``[3]``.
        roll: rotation about the viewing direction in rad.
        field_of_view: horizontal field of view in rad.
    """

    path: str
    position: Vector
    forward: Vector
    roll: float
    field_of_view: float

    def camera_to_world(self) -> NDArray[np.float64]:
        """Returns the camera-to-world pose ``[4, 4]`` in OpenCV axes (x right, y down, z forward)."""
        right = np.cross(self.forward, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        down = np.cross(self.forward, right)
        c, s = np.cos(self.roll), np.sin(self.roll)
        pose = np.eye(4)
        pose[:3, 0], pose[:3, 1] = c * right + s * down, c * down - s * right
        pose[:3, 2], pose[:3, 3] = self.forward, self.position
        return pose


def plan(space: Any, rng: np.random.Generator, count: int) -> list[View]:
    """Draws ``count`` views on paths of all kinds; if the room lacks space for a kind, other kinds get its views.

    Raises:
        ValueError: if the room has no space for ``count`` views.
    """
    quotas = {kind: round(count * share / sum(SHARES.values())) for kind, share in SHARES.items()}
    quotas["walk"] += count - sum(quotas.values())
    views: list[View] = []
    for kind, quota in sorted(quotas.items(), key=lambda item: item[0] == "walk"):
        views += _several(space, rng, kind, quota)
    for kind in ("walk", "turn", "far"):
        views += _several(space, rng, kind, count - len(views), first=10)
    if len(views) < count:
        raise ValueError(f"the room has space for {len(views)} of {count} views")
    return views


def _several(space: Any, rng: np.random.Generator, kind: str, quota: int, first: int = 0) -> list[View]:
    """Draws paths of one kind until the quota is met or no path is found."""
    views: list[View] = []
    number = first
    while len(views) < quota:
        field_of_view = np.radians(rng.uniform(55, 85))
        path = _longest(space, rng, kind, quota - len(views), field_of_view)
        # Very short paths have too little overlap; accept them only to fill the rest of a quota.
        if len(path) < min(3, quota - len(views)):
            break
        views += [View(f"{kind}_{number}", *look, rng.normal(0, 0.02), field_of_view) for look in path]
        number += 1
    return views


_Path = list[tuple[Vector, Vector]]  # positions and viewing directions


def _longest(space: Any, rng: np.random.Generator, kind: str, count: int, field_of_view: float) -> _Path:
    """The longest of several random paths, with at most ``count`` views."""
    draw, most, tries = _PATHS[kind]
    best: _Path = []
    if kind in ("orbit_near", "orbit_far", "near") and not len(space.objects):
        return best
    for _ in range(tries):
        best = max(best, draw(space, rng, count, field_of_view), key=len)
        if len(best) >= min(count, most):
            break
    return best[: min(count, most)]


def _free(space: Any, point: Vector, margin: float = _MARGIN) -> bool:
    """Whether a camera fits: inside the room, with free space around it, and not inside a solid (many back hits)."""
    if not space.inside(point) or not space.low[2] + 0.15 < point[2] < space.high[2] - 0.15:
        return False
    backs = 0
    for direction in _SIDES:
        distance, back = space.cast(point, direction)
        if distance < margin:
            return False
        backs += back or not np.isfinite(distance)
    return backs < len(_SIDES) / 3


def _looks_at_room(space: Any, position: Vector, forward: Vector, field_of_view: float, least: float) -> bool:
    """Whether a view shows enough of the room, tested with a grid of rays.

    The median distance must be at least ``least``, and the smallest above 0.1 m. If ``least`` is 0.8 m or more, the
    largest distance must also exceed 1.5 times the smallest, which excludes views of a bare wall.
    """
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    half = np.tan(field_of_view / 2)
    distances = []
    for x in (-0.8, -0.4, 0.0, 0.4, 0.8):
        for y in (-0.35, 0.0, 0.35):
            ray = forward + half * (x * right + y * up)
            distances.append(space.cast(position, ray / np.linalg.norm(ray))[0])
    varied = least < 0.8 or max(distances) > 1.5 * min(distances)
    return varied and float(np.median(distances)) >= least and min(distances) > 0.1


def _look(pan: float, nod: float) -> Vector:
    return np.array([np.cos(pan) * np.cos(nod), np.sin(pan) * np.cos(nod), np.sin(nod)])


def _toward(position: Vector, target: Vector) -> Vector:
    return (target - position) / np.linalg.norm(target - position)


def _sees(space: Any, position: Vector, target: Vector, radius: float) -> bool:
    """Whether an object of some radius at ``target`` is not occluded."""
    return space.cast(position, _toward(position, target))[0] > np.linalg.norm(target - position) - 1.2 * radius - 0.1


def _stand(space: Any, rng: np.random.Generator, margin: float = _MARGIN) -> Vector | None:
    """Draws a free position at the height of a handheld camera, 1.1 to 1.75 m; None if none is found."""
    for _ in range(_TRIES):
        point = rng.uniform(space.low, space.high)
        point[2] = min(space.low[2] + rng.uniform(1.1, 1.75), space.high[2] - 0.4)
        if _free(space, point, margin):
            return point
    return None


def _walk(space: Any, rng: np.random.Generator, count: int, field_of_view: float) -> _Path:
    """A straight walk with bobbing and a slow pan, in steps of 8 to 25 cm."""
    start, end = _stand(space, rng), _stand(space, rng)
    if start is None or end is None or np.linalg.norm(end - start) < 0.8:
        return []
    step = rng.uniform(0.08, 0.25)
    way = _toward(start, end)
    pan = np.arctan2(way[1], way[0]) + rng.choice((0.0, 0.6, -0.6, 1.57, -1.57)) + rng.normal(0, 0.2)
    turn, nod = rng.normal(0, 0.06), rng.uniform(-0.35, 0.05)
    path: _Path = []
    for i in range(min(count, 1 + int(np.linalg.norm(end - start) / step))):
        position = start + i * step * way + rng.normal(0, 0.015, 3)
        forward = _look(pan + i * turn + rng.normal(0, 0.02), nod + rng.normal(0, 0.02))
        if not _free(space, position) or not _looks_at_room(space, position, forward, field_of_view, 0.8):
            break
        path.append((position, forward))
    return path


def _turn(space: Any, rng: np.random.Generator, count: int, field_of_view: float) -> _Path:
    """A turn on the spot in steps of 10 to 35 degrees, with the camera 5 to 35 cm from the axis."""
    stand = _stand(space, rng, 0.4)
    if stand is None:
        return []
    step, arm = np.radians(rng.uniform(10, 35)) * rng.choice((-1, 1)), rng.uniform(0.05, 0.35)
    pan, nod = rng.uniform(0, 2 * np.pi), rng.uniform(-0.35, 0.1)
    path: _Path = []
    for i in range(count):
        forward = _look(pan + i * step, nod + rng.normal(0, 0.03))
        position = stand + arm * _look(pan + i * step, 0.0) + rng.normal(0, 0.01, 3)
        if not _free(space, position) or not _looks_at_room(space, position, forward, field_of_view, 0.8):
            break
        path.append((position, forward))
    return path


def _orbit(near: bool, space: Any, rng: np.random.Generator, count: int, field_of_view: float) -> _Path:
    """An orbit around an object in steps of 10 to 40 degrees; positions that are not free are skipped."""
    *center, size = space.objects[rng.integers(len(space.objects))]
    target = np.array(center)
    distance = size + (rng.uniform(0.35, 0.9) if near else rng.uniform(1.0, 2.5))
    height = target[2] + (rng.uniform(0.05, 0.6) if near else rng.uniform(0.2, 1.0))
    height = min(max(height, space.low[2] + 0.3), space.high[2] - 0.3)
    start, step = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(10, 40)) * rng.choice((-1, 1))
    path: _Path = []
    for i in range(min(2 * count, int(2 * np.pi / abs(step)))):
        for scale in (1.0, 0.8, 1.25):
            offset = scale * distance * _look(start + i * step, 0.0)
            position = np.array([target[0], target[1], height]) + offset + rng.normal(0, 0.02, 3)
            forward = _toward(position, target + rng.normal(0, 0.06 * size + 0.02, 3))
            if _sees(space, position, target, size) and _free(space, position):
                path.append((position, forward))
                break
    return path


def _near(space: Any, rng: np.random.Generator, count: int, field_of_view: float) -> _Path:
    """A sideways pass in front of an object, at 30 to 70 cm."""
    *center, size = space.objects[rng.integers(len(space.objects))]
    target = np.array(center)
    away = _look(rng.uniform(0, 2 * np.pi), rng.uniform(0.0, 0.9))
    middle = target + (0.6 * size + rng.uniform(0.3, 0.7)) * away
    side = np.cross(away, (0.0, 0.0, 1.0)) / np.cos(np.arcsin(away[2]))
    step = rng.uniform(0.04, 0.12)
    path: _Path = []
    for i in range(count):
        position = middle + (i - count / 2) * step * side + rng.normal(0, 0.01, 3)
        forward = _toward(position, target + 0.5 * (i - count / 2) * step * side)
        seen = _sees(space, position, target, size) and _looks_at_room(space, position, forward, field_of_view, 0.3)
        if seen and _free(space, position):
            path.append((position, forward))
        elif path:
            break
    return path


def _far(space: Any, rng: np.random.Generator, count: int, field_of_view: float) -> _Path:
    """Views across the room from random positions (wide baselines), towards the farthest of four directions."""
    middle = (space.low + space.high) / 2
    path: _Path = []
    for _ in range(4 * count):
        position = _stand(space, rng)
        if position is None or len(path) == count:
            break
        across = np.arctan2(*(middle - position)[1::-1])
        looks = [_look(across + rng.normal(0, 0.4), rng.uniform(-0.35, 0.0)) for _ in range(4)]
        distances = [space.cast(position, look)[0] for look in looks]
        forward = looks[int(np.argmax(distances))]
        if _looks_at_room(space, position, forward, field_of_view, 1.5):
            path.append((position, forward))
    return path


# how a path of a kind is drawn, the most views that it has, and the number of tries of which the longest is taken
_PATHS: dict[str, tuple[Callable[[Any, np.random.Generator, int, float], _Path], int, int]] = {
    "walk": (_walk, 12, 12),
    "turn": (_turn, 10, 12),
    "orbit_near": (partial(_orbit, True), 12, 40),
    "orbit_far": (partial(_orbit, False), 12, 40),
    "near": (_near, 6, 40),
    "far": (_far, 1_000, 1),
}
