"""Procedural streets and yards under an open sky, with a camera that moves forward; generated from a seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from examples.worlds import street
from examples.worlds.street import Builder
from vg2gt.data.synthetic.renderer import World
from vg2gt.data.synthetic.synthetic_scene import SyntheticScene, level_poses
from vg2gt.data.synthetic.textures import Pattern

_STREAM = 2  # separates the random stream of outdoor scenes from that of rooms with the same seed
_BEGIN, _END = -25.0, 88.0  # built-up section of the street in metres; the camera starts at 0 and looks along x
_BOUNDS = np.array([[-40.0, -60.0, 0.0], [90.0, 60.0, 60.0]])  # beyond these, everything is sky
_FREE = 1.4  # free space on either side of the camera path in metres
_SUN_DISTANCE = 1e4  # metres; makes shadows parallel to half a degree

GROUND_COLORS = ((0.12, 0.22, 0.06), (0.22, 0.25, 0.1), (0.3, 0.26, 0.2), (0.26, 0.25, 0.24))
_PAVING = (Pattern.CHECKS, Pattern.BRICKS, Pattern.MOSAIC, Pattern.PLANKS, Pattern.CLOUDS)


@dataclass(frozen=True)
class _Plan:
    """Ground plan: a strip along x with buildings on both sides.

    Attributes:
        road: half the width of the road; 0 in a yard, which has no road.
        front: distance of the fronts or gardens from the middle.
        setback: maximum distance of houses behind ``front``.
        end: x at which a building or trees close the view.
        gap: probability that a plot has no house.
    """

    road: float
    front: float
    setback: float
    end: float
    gap: float


class SyntheticOutdoor(SyntheticScene):
    """A street or a yard with sun, shadows and a sky without depth; the camera moves forward along x.

    The origin of the world frame is on the ground where the camera starts. Depth ranges from about 1 m to 90 m.

    The arguments are those of :class:`~vg2gt.data.synthetic.rooms.SyntheticRoom`.
    """

    version = 1  # increment whenever the same seed would give different pixels

    def __init__(self, seed: int, num_frames: int, size: tuple[int, int], highlights: bool | str = False) -> None:
        stream = (self.version, seed, _STREAM)
        rng = np.random.default_rng(stream)
        builder = Builder(rng)
        plan = _draw_plan(rng)
        ground = builder.tinted_material(street.pick(builder, GROUND_COLORS), (Pattern.CLOUDS,), (1, 6))
        if plan.road:
            _pave(builder, plan)
            _park(builder, plan)
        for side in (-1, 1):
            _build_side(builder, plan, side)
        _close_view(builder, plan)
        _scatter(builder, plan)
        builder.end_group()
        world = open_world(builder, ground, _BOUNDS)
        super().__init__(world, _camera_path(rng, num_frames), rng.uniform(1.1, 1.5), size, stream, highlights)


def _draw_plan(rng: np.random.Generator) -> _Plan:
    if rng.random() < 0.65:
        road = rng.uniform(2.2, 4.8)
        front = road + rng.uniform(1.6, 3.0)
        return _Plan(road, front, rng.uniform(0.0, 6.0), rng.uniform(50, 82), rng.uniform(0.1, 0.5))
    return _Plan(0.0, rng.uniform(5, 11), rng.uniform(0.0, 3.0), rng.uniform(18, 50), rng.uniform(0.2, 0.6))


def _pave(builder: Builder, plan: _Plan) -> None:
    """Builds the road, pavements and the centre line."""
    rng, length, middle = builder.rng, _END - _BEGIN, (_BEGIN + _END) / 2
    builder.place(np.zeros(3), 0.0)
    asphalt = builder.tinted_material((0.16, 0.16, 0.17), (Pattern.CLOUDS, Pattern.BRICKS, Pattern.PLAIN), (1, 8))
    builder.box((middle, 0, 0.01), (length, 2 * plan.road, 0.02), asphalt)
    paving = builder.tinted_material((0.4, 0.38, 0.36), _PAVING, (0.8, 3))
    kerb = builder.tinted_material((0.45, 0.45, 0.43), (Pattern.STRIPES, Pattern.PLAIN), (0.5, 1))
    for side in (-1, 1):
        width = plan.front - plan.road
        builder.box((middle, side * (plan.road + width / 2), 0.06), (length, width, 0.12), paving)
        builder.box((middle, side * plan.road, 0.065), (length, 0.16, 0.13), kerb)
    if plan.road > 3 and rng.random() < 0.7:
        white = builder.tinted_material((0.7, 0.7, 0.68), (Pattern.CLOUDS,), (4, 8))
        for x in np.arange(_BEGIN + rng.uniform(0, 6), _END, 6.0):
            builder.place(np.zeros(3), 0.0)
            builder.box((x, 0, 0.012), (3.0, 0.14, 0.024), white)


def _park(builder: Builder, plan: _Plan) -> None:
    """Parks cars along the kerbs if the road is wide enough for the camera path."""
    rng = builder.rng
    if plan.road < _FREE + 2.0:
        return
    for side in (-1, 1):
        share, x = rng.uniform(0, 0.8), _BEGIN + rng.uniform(0, 5)
        while x < min(_END - 3, plan.end - 6):
            if rng.random() < share:
                builder.place(np.array([x, side * (plan.road - 1.05), 0.0]), rng.choice((0.0, np.pi)))
                street.car(builder)
            x += rng.uniform(5.2, 7.5)


def _build_side(builder: Builder, plan: _Plan, side: int) -> None:
    """Builds houses and, between them, gardens with trees, hedges and fences."""
    rng, x = builder.rng, _BEGIN
    facing = -side * np.pi / 2  # fronts face the street
    tall = rng.uniform(4, 12)
    while x < _END - 6:
        width = rng.uniform(7, 16)
        y = plan.front + rng.uniform(0, plan.setback)
        if rng.random() >= plan.gap:
            builder.place(np.array([x + width / 2, side * y, 0.0]), facing)
            street.building(builder, width - rng.uniform(0, 1.5), rng.uniform(7, 11), tall * rng.uniform(0.7, 1.4))
        else:
            for _ in range(rng.integers(1, 4)):
                builder.place(
                    np.array([x + rng.uniform(1, width - 1), side * (plan.front + rng.uniform(1.5, 9)), 0]), 0
                )
                street.tree(builder)
            if y < 25 and rng.random() < 0.6:
                builder.place(np.array([x + width / 2, side * (plan.front + 0.3), 0.0]), facing)
                (street.hedge if rng.random() < 0.5 else street.fence)(builder, width - 0.6)
        x += width


def _close_view(builder: Builder, plan: _Plan) -> None:
    """Closes the end of the street with a house, a row of trees, or nothing."""
    rng, kind = builder.rng, builder.rng.random()
    if kind < 0.5:
        builder.place(np.array([plan.end, rng.uniform(-3, 3), 0.0]), np.pi)
        depth = min(_BOUNDS[1, 0] - plan.end - 1, 10.0)
        street.building(builder, 2 * plan.front + rng.uniform(-2, 10), depth, rng.uniform(5, 18))
    elif kind < 0.85:
        for y in np.arange(-plan.front - 6, plan.front + 6, 2.5):
            builder.place(np.array([plan.end + rng.uniform(-2, 2), y + rng.uniform(-1, 1), 0.0]), 0.0)
            street.tree(builder)


def _scatter(builder: Builder, plan: _Plan) -> None:
    """Scatters trees and small objects on the pavements or in the yard, away from the camera path and each other."""
    rng = builder.rng
    placed = np.zeros((0, 2))
    for _ in range(rng.integers(18, 36)):
        x, side = rng.uniform(-5, min(plan.end - 3, 60)), rng.choice((-1, 1))
        is_tree = rng.random() < 0.4
        if plan.road:
            y = plan.road + 0.5 + rng.uniform(0, max(plan.front - plan.road - 1.0, 0.1))
        else:
            y = rng.uniform(_FREE + (1.8 if is_tree else 1.0), plan.front - 0.8)
        place = np.array([x, side * y])
        if len(placed) and np.linalg.norm(placed - place, axis=1).min() < 1.6:
            continue
        placed = np.vstack((placed, place))
        builder.place(np.array([*place, 0.0]), -side * np.pi / 2 if plan.road else rng.uniform(0, 2 * np.pi))
        make = street.tree if is_tree else street.SMALL[rng.integers(len(street.SMALL))]
        if not plan.road and not is_tree and rng.random() < 0.2 and y > _FREE + 2.6:
            make = street.car
        make(builder)


def _draw_sky(rng: np.random.Generator, sun: NDArray[np.float64]) -> NDArray[np.float64]:
    """Draws a sky ``[SKY_COLUMNS]`` with the sun in unit direction ``sun`` ``[3]``."""
    blue = rng.uniform((0.08, 0.2, 0.5), (0.2, 0.36, 0.8))
    haze = rng.uniform((0.5, 0.58, 0.65), (0.75, 0.75, 0.8))
    clouds = (rng.uniform(0.0, 1.2), rng.uniform(0.5, 1.5), rng.integers(1 << 20))
    return np.array([*haze, *blue, *sun, rng.uniform(0.1, 0.5), *clouds])


def open_world(builder: Builder, ground: int, bounds: NDArray[np.float64]) -> World:
    """Finishes a world under a sky with a sun.

    Args:
        builder: what stands in it.
        ground: material of the ground.
        bounds: lower and upper corner ``[2, 3]`` in metres; beyond these, everything is sky.
    """
    rng = builder.rng
    height, turn = rng.uniform(0.4, 1.1), rng.uniform(0, 2 * np.pi)
    sun = np.array([np.cos(height) * np.cos(turn), np.cos(height) * np.sin(turn), np.sin(height)])
    color = rng.uniform(0.85, 1.25) * np.array([1.0, rng.uniform(0.88, 0.97), rng.uniform(0.7, 0.92)])
    color *= 0.5 + 0.25 * _SUN_DISTANCE**2  # cancels the fall-off with distance
    lights = np.concatenate((_SUN_DISTANCE * sun, color))[None]
    ambient = float(rng.uniform(0.35, 0.55))
    materials = np.full(6, ground)
    return World(bounds, materials, lights=lights, ambient=ambient, sky=_draw_sky(rng, sun), **builder.arrays())


def _camera_path(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Camera-to-world poses ``[count, 4, 4]``: forward along the free strip, with smoothly changing direction."""

    def swing(size: float) -> NDArray[np.float64]:
        return size * np.sin(s * np.pi * rng.uniform(0.5, 2) + rng.uniform(0, 2 * np.pi))

    s = np.linspace(0, 1, count)
    across = rng.uniform(-0.5, 0.5) + swing(rng.uniform(0.1, 0.5))
    height = rng.uniform(1.4, 1.9) + swing(0.05)
    position = np.stack((rng.uniform(3, 12) * s, across, height), 1)
    return level_poses(position, rng.uniform(-0.35, 0.35) + swing(0.3), rng.uniform(-0.12, 0.08) + swing(0.06))
