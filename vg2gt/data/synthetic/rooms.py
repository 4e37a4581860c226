"""Procedural rooms: furniture, lamps and a camera path, all drawn from one seed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vg2gt.data.synthetic.builder import Builder
from vg2gt.data.synthetic.furniture import MAKERS
from vg2gt.data.synthetic.renderer import World
from vg2gt.data.synthetic.synthetic_scene import SyntheticScene, level_poses
from vg2gt.data.synthetic.textures import INDOOR, Pattern

_FLOOR_PATTERNS = (Pattern.CHECKS, Pattern.BRICKS, Pattern.CLOUDS, Pattern.WOOD, Pattern.MOSAIC, Pattern.PLANKS)
_CEILING_PATTERNS = (Pattern.PLAIN, Pattern.CLOUDS, Pattern.BRICKS)
_PICTURE_PATTERNS = tuple(pattern for pattern in INDOOR if pattern not in (Pattern.PLAIN, Pattern.BRICKS))
_WALL_GAP = 0.55  # metres from a wall to the centre of the furniture along it
TRIES = 200


class SyntheticRoom(SyntheticScene):
    """A furnished room with a camera path. The world origin is at the centre of the floor.

    Args:
        seed: random seed; it and the number of frames determine the scene.
        num_frames: number of cameras on the path, at least 1.
        size: image ``(height, width)``.
        highlights: see ``draw_highlights``; changes only colours.
    """

    version = 1  # increase it when the same seed gives different pixels

    def __init__(self, seed: int, num_frames: int, size: tuple[int, int], highlights: bool | str = False) -> None:
        stream = (self.version, seed)
        rng = np.random.default_rng(stream)
        extent = rng.uniform((3.5, 3.5, 2.4), (7.0, 7.0, 3.3))
        builder = Builder(rng)
        shell = _shell_materials(builder)
        _hang_pictures(builder, extent)
        occupied = _furnish(builder, extent)
        world = _finish(builder, extent, shell)
        poses = self._path(rng, extent, occupied, num_frames)
        super().__init__(world, poses, rng.uniform(1.2, 1.55), size, stream, highlights)

    def _path(
        self, rng: np.random.Generator, extent: NDArray[np.float64], occupied: NDArray[np.float64], count: int
    ) -> NDArray[np.float64]:
        """Returns camera-to-world poses ``[count, 4, 4]`` on an arc over free floor, with smooth pan and nod."""
        s = np.linspace(0, 1, count)
        floor = _free_arc(rng, extent, occupied, s)
        height = rng.uniform(1.0, 1.7) + 0.15 * np.sin(s * np.pi * rng.uniform(0.5, 2) + rng.uniform(0, 6))
        height = np.minimum(height, extent[2] - 0.4)
        pan = rng.uniform(0, 2 * np.pi) + rng.choice((-1, 1)) * rng.uniform(1.2, 2.4) * s + 0.1 * np.sin(7 * s)
        nod = -rng.uniform(0, 0.35) + 0.15 * np.sin(s * np.pi * rng.uniform(0.6, 2) + rng.uniform(0, 6))
        return level_poses(np.column_stack((floor, height)), pan, nod)


def _shell_materials(builder: Builder) -> NDArray[np.int64]:
    """Draws materials of the four walls, the floor and the ceiling; in half of the rooms all walls share one."""
    own = builder.rng.random() < 0.5
    walls = [builder.new_material() for _ in range(4)] if own else [builder.new_material()] * 4
    return np.array([*walls, builder.new_material(_FLOOR_PATTERNS), builder.new_material(_CEILING_PATTERNS)])


def _hang_pictures(builder: Builder, extent: NDArray[np.float64]) -> None:
    rng = builder.rng
    for _ in range(rng.integers(2, 7)):
        width, height = rng.uniform(0.4, 1.6), rng.uniform(0.4, 1.2)
        side, axis = rng.choice((-1, 1)), int(rng.integers(2))
        position = np.array([0.0, 0.0, rng.uniform(1.0, extent[2] - 0.7)])
        position[axis] = side * (extent[axis] / 2 - 0.02)
        along = extent[1 - axis] / 2 - 0.8
        position[1 - axis] = rng.uniform(-along, along)
        builder.place(position, 0.0 if axis == 0 else np.pi / 2)
        builder.box((0, 0, 0), (0.05, width, height), builder.new_material(_PICTURE_PATTERNS, (2, 14)))


def _furnish(builder: Builder, extent: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places furniture without overlap; returns ``[n, 3]`` x, y and radius of the occupied floor."""
    rng = builder.rng
    occupied: list[tuple[float, float, float]] = []
    for _ in range(rng.integers(7, 14)):
        make = MAKERS[rng.integers(len(MAKERS))]
        for _ in range(10):
            position, yaw = _candidate_place(rng, extent)
            if all(np.hypot(position[0] - x, position[1] - y) > radius + 0.45 for x, y, radius in occupied):
                builder.place(position, yaw)
                occupied.append((position[0], position[1], make(builder)))
                break
    builder.end_group()
    return np.array(occupied).reshape(-1, 3)


def _candidate_place(rng: np.random.Generator, extent: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Draws a position and yaw: along a wall, facing the room (60 %), or anywhere in its middle."""
    position = np.zeros(3)
    if rng.random() < 0.6:
        side, axis = rng.choice((-1, 1)), int(rng.integers(2))
        position[axis] = side * (extent[axis] / 2 - _WALL_GAP)
        position[1 - axis] = rng.uniform(-0.42, 0.42) * extent[1 - axis]
        front = (np.pi if side > 0 else 0.0) if axis == 0 else -side * np.pi / 2
        return position, front + rng.normal(0, 0.1)
    position[:2] = rng.uniform(-0.38, 0.38, 2) * extent[:2]
    return position, rng.uniform(0, 2 * np.pi)


def _finish(builder: Builder, extent: NDArray[np.float64], shell: NDArray[np.int64]) -> World:
    lights, ambient = draw_lamps(builder.rng, extent)
    half = extent[:2] / 2
    return World(
        walls=np.array([[-half[0], -half[1], 0.0], [half[0], half[1], extent[2]]]),
        wall_materials=shell,
        lights=lights,
        ambient=ambient,
        **builder.arrays(),
    )


def draw_lamps(rng: np.random.Generator, extent: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Draws one to three lamps ``[l, 6]`` (position, colour) below the ceiling, and the ambient light."""
    count = int(rng.integers(1, 4))
    position = rng.uniform(-0.4, 0.4, (count, 3)) * extent
    position[:, 2] = extent[2] - rng.uniform(0.1, 0.5, count)
    color = rng.uniform(0.8, 1.1, (count, 1)) * (1 + rng.uniform(-0.12, 0.12, (count, 3))) / np.sqrt(count)
    return np.concatenate((position, color), 1), float(rng.uniform(0.35, 0.6))


def _free_arc(
    rng: np.random.Generator, extent: NDArray[np.float64], occupied: NDArray[np.float64], s: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Draws a circular arc ``[len(s), 2]`` clear of walls and furniture; after ``TRIES`` draws, the clearest one."""
    best, best_clearance = np.zeros((len(s), 2)), -np.inf
    for _ in range(TRIES):
        middle = rng.uniform(-0.25, 0.25, 2) * extent[:2]
        angle = rng.uniform(0, 2 * np.pi) + rng.choice((-1, 1)) * rng.uniform(1.0, 2.2) * s
        arc = middle + rng.uniform(0.3, 0.9) * np.stack((np.cos(angle), np.sin(angle)), 1)
        walls = (extent[:2] / 2 - 0.4 - np.abs(arc)).min()
        gaps = np.linalg.norm(arc[:, None] - occupied[None, :, :2], axis=-1) - occupied[None, :, 2] - 0.15
        clearance = min(walls, gaps.min(initial=np.inf))
        if clearance > 0:
            return arc
        if clearance > best_clearance:
            best, best_clearance = arc, clearance
    return best
