"""Scenes seen from all around: an object on a bare surface, landmarks in front of a far background, and rooms."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from examples.worlds import street
from examples.worlds.outdoor import GROUND_COLORS, open_world
from examples.worlds.street import Builder
from vg2gt.data.synthetic.furniture import MAKERS
from vg2gt.data.synthetic.renderer import World
from vg2gt.data.synthetic.rooms import TRIES, SyntheticRoom, draw_lamps
from vg2gt.data.synthetic.synthetic_scene import SyntheticScene, level_poses
from vg2gt.data.synthetic.textures import INDOOR, Pattern

_STREAM = 3  # separates the random streams of these scenes from those of other variants with the same seed
_OPEN_SHARE = 0.4  # probability that an object is outdoors
_HORIZON = 500.0  # half the extent of an open world in metres
_OPEN = np.array([[-_HORIZON, -_HORIZON, 0.0], [_HORIZON, _HORIZON, 200.0]])
_BARE = (Pattern.PLAIN, Pattern.PLAIN, Pattern.CLOUDS, Pattern.WOOD)


class SyntheticObject(SyntheticScene):
    """An object on a large, often bare surface, photographed from all around in steps of 10 to 40 degrees.

    The surface is a floor or a table, in a room that may be empty, or outdoors with a far background. Each full orbit
    has a different height and distance. The origin of the world frame is on the floor below the object.

    The arguments are those of :class:`~vg2gt.data.synthetic.rooms.SyntheticRoom`.
    """

    version = 1  # increment whenever the same seed would give different pixels

    def __init__(self, seed: int, num_frames: int, size: tuple[int, int], highlights: bool | str = False) -> None:
        stream = (self.version, seed, _STREAM)
        rng = np.random.default_rng(stream)
        builder = Builder(rng)
        builder.place(np.zeros(3), 0.0)
        floor, top = _bare_material(builder), 0.0
        if rng.random() < 0.4:
            top = rng.uniform(0.5, 0.9)
            width = rng.uniform(1.2, 3.0, 2)
            builder.box((0, 0, top - 0.03), (width[0], width[1], 0.06), _bare_material(builder))
            builder.cylinder((0, 0, top / 2), 0.15, top - 0.06, builder.new_material())
        radius, height = _thing(builder, top)
        field_of_view = rng.uniform(0.9, 1.4)
        reach = max(radius, height / 2) * rng.uniform(1.4, 3.5) / np.tan(field_of_view / 2)
        reach = max(reach, radius + 0.3)
        target = np.array([0.0, 0.0, top + height / 2])
        position = _orbit(rng, target, reach, num_frames, np.radians(rng.uniform(10, 40)))
        farthest = float(np.linalg.norm(position[:, :2], axis=1).max())
        if rng.random() < _OPEN_SHARE:
            _fill_open(builder, farthest + 2.0, 60.0)
            world = open_world(builder, floor, _OPEN)
        else:
            half = farthest + rng.uniform(0.8, 4.0, 2)
            high = max(rng.uniform(2.4, 3.6), position[:, 2].max() + 0.4)
            extent = np.array([2 * half[0], 2 * half[1], high])
            if rng.random() < 0.6:
                _fill_room(builder, extent, farthest)
            world = _closed_world(builder, extent, floor)
        poses = _aim(rng, position, target, 0.15 * max(radius, height / 2))
        super().__init__(world, poses, field_of_view, size, stream, highlights)


class SyntheticLandmark(SyntheticScene):
    """Houses, trees and cars in an open place with hills and sky behind, seen with wide baselines; depth up to 500 m.

    The cameras are on an arc of 60 to 220 degrees around the place, 6 to 40 m away from it, in uneven steps. The origin
    of the world frame is on the ground in the middle of the place.

    The arguments are those of :class:`~vg2gt.data.synthetic.rooms.SyntheticRoom`.
    """

    version = 1  # increment whenever the same seed would give different pixels

    def __init__(self, seed: int, num_frames: int, size: tuple[int, int], highlights: bool | str = False) -> None:
        stream = (self.version, seed, _STREAM + 1)
        rng = np.random.default_rng(stream)
        builder = Builder(rng)
        ground = builder.tinted_material(street.pick(builder, GROUND_COLORS), (Pattern.CLOUDS,), (0.3, 3))
        place = rng.uniform(5, 16)
        _build_place(builder, place)
        gaps = rng.uniform(0.4, 1.6, num_frames)
        along = rng.uniform(0, 2 * np.pi) + np.radians(rng.uniform(60, 220)) * np.cumsum(gaps) / gaps.sum()
        away = (place + 6 + rng.uniform(0, 34)) * rng.uniform(0.85, 1.15, num_frames)
        away = np.maximum(away, place + 6)
        height = rng.uniform(1.3, 1.9) + rng.uniform(0, 0.3, num_frames)
        position = np.stack((away * np.cos(along), away * np.sin(along), height), 1)
        _fill_open(builder, float(away.max()) + 8, 0.6 * _HORIZON)
        world = open_world(builder, ground, _OPEN)
        poses = _aim(rng, position, np.array([0.0, 0.0, rng.uniform(-1, 3)]), 0.3 * place)
        super().__init__(world, poses, rng.uniform(0.9, 1.4), size, stream, highlights)


class SyntheticWideRoom(SyntheticRoom):
    """The room of the same seed, viewed across from free positions all around (wide baselines)."""

    def _path(
        self, rng: np.random.Generator, extent: NDArray[np.float64], occupied: NDArray[np.float64], count: int
    ) -> NDArray[np.float64]:
        """Camera-to-world poses ``[count, 4, 4]``, ordered by angle around the room's centre."""
        draws = rng.uniform(-0.5, 0.5, (max(TRIES, 20 * count), 2)) * (extent[:2] - 0.7)
        gaps = np.linalg.norm(draws[:, None] - occupied[None, :, :2], axis=-1) - occupied[None, :, 2]
        free = np.argsort(-np.minimum(gaps.min(1, initial=np.inf), 0.2), kind="stable")
        places = draws[free[: 3 * count]]
        chosen = [0]  # farthest-point sampling
        while len(chosen) < count:
            apart = np.linalg.norm(places[:, None] - places[None, chosen], axis=-1).min(1)
            chosen.append(int(np.argmax(apart)))
        places = places[chosen]
        places = places[np.argsort(np.arctan2(places[:, 1], places[:, 0]))]
        ahead = rng.normal(0, 0.1, (count, 2)) * extent[:2] - places
        height = np.minimum(rng.uniform(0.9, 1.8, count), extent[2] - 0.4)
        pan = np.arctan2(ahead[:, 1], ahead[:, 0]) + rng.normal(0, 0.25, count)
        return level_poses(np.column_stack((places, height)), pan, rng.uniform(-0.4, 0.05, count))


def _bare_material(builder: Builder) -> int:
    """Material with large plain areas; half of the time almost without texture."""
    material = builder.new_material(_BARE, (0.3, 3))
    if builder.rng.random() < 0.5:
        row = builder.materials[material]
        row[9], row[11] = 0.1 * row[9], 0.1 * row[11]
    return material


def _thing(builder: Builder, top: float) -> tuple[float, float]:
    """Places an object at height ``top``; returns its radius and height."""
    rng, first = builder.rng, len(builder.parts)
    builder.place(np.array([0.0, 0.0, top]), rng.uniform(0, 2 * np.pi))
    if top == 0 and rng.random() < 0.6:
        MAKERS[rng.integers(len(MAKERS))](builder)
    else:
        _pile(builder, rng.uniform(0.12, 0.5))
    builder.end_group()
    corners = builder.corners(first)
    return float(np.linalg.norm(corners[:, :2], axis=1).max()), float(corners[:, 2].max() - top)


def _pile(builder: Builder, size: float) -> None:
    """Builds a pile of boxes, cylinders and ellipsoids, similar to statues, toys or fruit."""
    rng, top = builder.rng, 0.0
    for level in range(rng.integers(2, 6)):
        x, y = rng.normal(0, 0.15, 2) * size * (level > 0)
        half = size * rng.uniform(0.15, 0.5, 3) * 0.85**level
        material, kind = builder.new_material(INDOOR, (3, 25)), rng.integers(3)
        if kind == 0:
            builder.box((x, y, top + half[2]), tuple(2 * half), material, turn=rng.uniform(0, np.pi))
        elif kind == 1:
            builder.cylinder((x, y, top + half[2]), half[0], 2 * half[2], material)
        else:
            builder.ellipsoid((x, y, top + half[2]), tuple(half), material)
        top += 1.9 * half[2]


def _orbit(
    rng: np.random.Generator, target: NDArray[np.float64], reach: float, count: int, step: float
) -> NDArray[np.float64]:
    """Camera positions ``[count, 3]`` around a target; each full orbit has a different height and distance."""
    angle = rng.uniform(0, 2 * np.pi) + rng.choice((-1, 1)) * step * (np.arange(count) + rng.uniform(-0.1, 0.1, count))
    turn = (step * np.arange(count) / (2 * np.pi)).astype(int)
    rise = np.radians(rng.uniform(5, 55, turn[-1] + 1))[turn] + rng.normal(0, 0.03, count)
    distance = reach * rng.uniform(0.8, 1.3, turn[-1] + 1)[turn] * rng.uniform(0.95, 1.05, count)
    around = np.stack((np.cos(angle) * np.cos(rise), np.sin(angle) * np.cos(rise), np.sin(rise)), 1)
    return target + distance[:, None] * around


def _aim(
    rng: np.random.Generator, position: NDArray[np.float64], target: NDArray[np.float64], error: float
) -> NDArray[np.float64]:
    """Camera-to-world poses ``[n, 4, 4]`` that look at a target, with a random error in metres (half vertically)."""
    ahead = target + rng.normal(0, error, position.shape) * (1.0, 1.0, 0.5) - position
    return level_poses(
        position, np.arctan2(ahead[:, 1], ahead[:, 0]), np.arctan2(ahead[:, 2], np.hypot(*ahead[:, :2].T))
    )


def _around(rng: np.random.Generator, near: float, far: float, facing: bool) -> tuple[NDArray[np.float64], float]:
    """Random position between two distances from the origin (log-uniform), and yaw; ``facing`` faces the origin."""
    angle, distance = rng.uniform(0, 2 * np.pi), np.exp(rng.uniform(np.log(near), np.log(far)))
    yaw = angle + np.pi if facing else rng.uniform(0, 2 * np.pi)
    return distance * np.array([np.cos(angle), np.sin(angle), 0.0]), yaw


def _fill_open(builder: Builder, near: float, far: float) -> None:
    """Places small objects, houses and hills farther than ``near``."""
    rng = builder.rng
    for _ in range(rng.integers(0, 16)):
        builder.place(*_around(rng, near + 2, max(far, near + 10), True))
        makers = (street.tree, *street.SMALL)
        makers[rng.integers(len(makers))](builder)
    for _ in range(rng.integers(0, 8)):
        builder.place(*_around(rng, near + 12, max(far, near + 60), True))
        street.building(builder, rng.uniform(7, 20), rng.uniform(7, 12), rng.uniform(4, 25))
    for _ in range(rng.integers(0, 9)):
        size = np.array([*rng.uniform(25, 80, 2), rng.uniform(6, 45)])
        place, yaw = _around(rng, near + 1.1 * max(size), _HORIZON - 90, False)
        builder.place(place, yaw)
        hill = builder.tinted_material(street.pick(builder, street.GREENS), (Pattern.CLOUDS,), (0.05, 0.5))
        builder.ellipsoid((0, 0, 0), tuple(size), hill)
    builder.end_group()


def _build_place(builder: Builder, radius: float) -> None:
    """Builds what the cameras look at: one to three houses with objects around them."""
    rng = builder.rng
    for _ in range(rng.integers(1, 4)):
        width, depth = rng.uniform(3, 0.8 * radius + 1), rng.uniform(3, 6)
        builder.place(np.array([*rng.uniform(-0.2, 0.2, 2) * radius, 0.0]), rng.uniform(0, 2 * np.pi))
        street.building(builder, width, depth, rng.uniform(3, 14))
    makers = (street.tree, street.car, *street.SMALL)
    for _ in range(rng.integers(4, 18)):
        builder.place(*_around(rng, 0.4 * radius, radius, False))
        makers[rng.integers(len(makers))](builder)
    builder.end_group()


def _fill_room(builder: Builder, extent: NDArray[np.float64], free: float) -> None:
    """Places furniture outside the camera path, in the corners and along the walls."""
    rng = builder.rng
    for _ in range(rng.integers(3, 12)):
        place = rng.uniform(-0.45, 0.45, 3) * extent
        place[2] = 0.0
        if np.linalg.norm(place[:2]) < free + 1.2:
            continue
        builder.place(place, np.arctan2(-place[1], -place[0]) + rng.normal(0, 0.3))
        MAKERS[rng.integers(len(MAKERS))](builder)
    builder.end_group()


def _closed_world(builder: Builder, extent: NDArray[np.float64], floor: int) -> World:
    rng = builder.rng
    own: Sequence[int] = [_bare_material(builder) for _ in range(5)]
    walls = own[:4] if rng.random() < 0.3 else own[:1] * 4
    lights, ambient = draw_lamps(rng, extent)
    half = extent[:2] / 2
    return World(
        walls=np.array([[-half[0], -half[1], 0.0], [half[0], half[1], extent[2]]]),
        wall_materials=np.array([*walls, floor, own[4]]),
        lights=lights,
        ambient=ambient,
        **builder.arrays(),
    )
