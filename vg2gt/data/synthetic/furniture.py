"""Furniture composed of boxes, cylinders and ellipsoids, with random proportions and materials.

Every maker draws from the builder's random generator, places parts in its own frame (x is the front, z up, the floor at
z = 0) and returns the radius of the floor area it occupies. Lengths are in metres.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vg2gt.data.synthetic.builder import Builder
from vg2gt.data.synthetic.textures import Pattern


def _legs(b: Builder, x: float, y: float, height: float, thickness: float, material: int) -> None:
    for sx in (-1, 1):
        for sy in (-1, 1):
            b.box((sx * x, sy * y, height / 2), (thickness, thickness, height), material)


def crates(b: Builder) -> float:
    """One box, or two stacked boxes."""
    size = b.rng.uniform(0.3, 0.9, 3)
    b.box((0, 0, size[2] / 2), tuple(size), b.new_material())
    if b.rng.random() < 0.5:
        upper = size * b.rng.uniform(0.3, 0.7)
        b.box((0, 0, size[2] + upper[2] / 2), tuple(upper), b.new_material(), turn=b.rng.normal(0, 0.3))
    return 0.7 * float(max(size[:2]))


def barrel(b: Builder) -> float:
    """An upright cylinder."""
    radius, height = b.rng.uniform(0.12, 0.4), b.rng.uniform(0.4, 1.4)
    b.cylinder((0, 0, height / 2), radius, height, b.new_material())
    return radius


def ball(b: Builder) -> float:
    """An ellipsoid on the floor."""
    radius, height = b.rng.uniform(0.2, 0.5), b.rng.uniform(0.2, 0.5)
    b.ellipsoid((0, 0, height), (radius, radius, height), b.new_material())
    return radius


def table(b: Builder) -> float:
    """A table with objects on it."""
    rng = b.rng
    length, depth, height = rng.uniform(0.7, 1.4), rng.uniform(0.6, 0.9), rng.uniform(0.6, 0.8)
    b.box((0, 0, height), (length, depth, 0.05), b.new_material())
    _legs(b, length / 2 - 0.06, depth / 2 - 0.06, height, 0.06, b.new_material())
    for _ in range(rng.integers(0, 4)):
        x, y = rng.uniform(-0.35, 0.35) * length, rng.uniform(-0.3, 0.3) * depth
        top = height + 0.025
        if rng.random() < 0.5:
            size = rng.uniform(0.08, 0.3, 3)
            b.box((x, y, top + size[2] / 2), tuple(size), b.new_material(), turn=rng.uniform(0, np.pi))
        else:
            tall = rng.uniform(0.1, 0.3)
            b.cylinder((x, y, top + tall / 2), rng.uniform(0.05, 0.14), tall, b.new_material())
    return 0.6 * length


def chair(b: Builder) -> float:
    """A chair."""
    material, seat = b.new_material(), 0.45
    b.box((0, 0, seat), (0.45, 0.45, 0.06), material)
    b.box((-0.2, 0, seat + 0.25), (0.05, 0.45, 0.5), material)
    _legs(b, 0.19, 0.19, seat, 0.05, b.new_material())
    return 0.35


def shelf(b: Builder) -> float:
    """A shelf with books; every board is a separate group."""
    rng = b.rng
    width, height, boards = rng.uniform(0.7, 1.3), rng.uniform(0.9, 2.0), int(rng.integers(2, 5))
    material, gap = b.new_material(), height / boards
    b.box((-0.2, 0, height / 2), (0.03, width, height), b.new_material())
    for side in (-1, 1):
        b.box((0, side * width / 2, height / 2), (0.35, 0.04, height), material)
    for board in range(boards + 1):
        b.end_group()
        b.box((0, 0, board * gap), (0.35, width, 0.03), material)
        y = -width / 2 + 0.06
        while board < boards and y < width / 2 - 0.12:
            thick = rng.uniform(0.04, 0.16)
            if rng.random() < 0.75:
                tall = gap * rng.uniform(0.4, 0.85)
                lean = rng.normal(0, 0.04)
                center = (0.0, y + thick / 2, board * gap + tall / 2 + 0.015)
                b.box(center, (rng.uniform(0.15, 0.28), 0.85 * thick, tall), b.new_material(), tilt=lean)
            y += thick
    return 0.6 * width


def sofa(b: Builder) -> float:
    """A sofa with cushions."""
    rng = b.rng
    width, material = rng.uniform(1.2, 1.9), b.new_material()
    b.box((0, 0, 0.2), (0.8, width, 0.4), material)
    b.box((-0.3, 0, 0.6), (0.2, width, 0.45), material)
    for side in (-1, 1):
        b.box((0, side * (width / 2 - 0.09), 0.5), (0.8, 0.18, 0.25), material)
    for _ in range(rng.integers(1, 4)):
        y = rng.uniform(-0.35, 0.35) * width
        b.box((-0.1, y, 0.58), (0.15, 0.35, 0.35), b.new_material(), turn=rng.normal(0, 0.2), tilt=rng.normal(0, 0.15))
    return 0.6 * width


def lamp(b: Builder) -> float:
    """A standing lamp."""
    height, radius = b.rng.uniform(1.2, 1.7), b.rng.uniform(0.12, 0.22)
    b.cylinder((0, 0, height / 2), 0.03, height, b.new_material())
    b.cylinder((0, 0, 0.015), 0.18, 0.03, b.new_material())
    b.ellipsoid((0, 0, height), (radius, radius, 0.8 * radius), b.new_material())
    return 0.25


def plant(b: Builder) -> float:
    """A pot with leaves."""
    rng = b.rng
    pot, height = rng.uniform(0.12, 0.22), rng.uniform(0.2, 0.4)
    b.cylinder((0, 0, height / 2), pot, height, b.new_material())
    leaves = b.new_material((Pattern.CLOUDS, Pattern.STRIPES, Pattern.DOTS), (4, 14))
    for _ in range(rng.integers(4, 9)):
        x, y = rng.normal(0, 0.13, 2)
        radii = rng.uniform(0.05, 0.2, 3)
        b.ellipsoid((x, y, height + rng.uniform(0.1, 0.6)), tuple(radii), leaves)
    return 0.35


def cabinet(b: Builder) -> float:
    """A chest with drawers and knobs."""
    rng = b.rng
    width, height, rows = rng.uniform(0.6, 1.2), rng.uniform(0.6, 1.3), int(rng.integers(2, 5))
    b.box((0, 0, height / 2), (0.45, width, height), b.new_material())
    front, knob = b.new_material(), b.new_material((Pattern.PLAIN,))
    for row in range(rows):
        z = (row + 0.5) * height / rows
        b.box((0.235, 0, z), (0.03, 0.92 * width, 0.85 * height / rows), front)
        for side in (-1, 1):
            b.ellipsoid((0.27, side * 0.25 * width, z), (0.025, 0.025, 0.025), knob)
    return 0.6 * width


MAKERS: tuple[Callable[[Builder], float], ...] = (
    crates, barrel, ball, table, chair, shelf, sofa, lamp, plant, cabinet,
)  # fmt: skip
