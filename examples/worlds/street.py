"""Objects along a street: buildings, trees, cars, lamp posts and smaller objects, with random proportions.

Like furniture, objects are built in the builder's frame: x points to the front, z up, the ground is at z = 0. Lengths
are in metres.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vg2gt.data.synthetic import builder
from vg2gt.data.synthetic.builder import Vector
from vg2gt.data.synthetic.textures import INDOOR, Pattern

GREENS: tuple[Vector, ...] = ((0.10, 0.24, 0.05), (0.2, 0.3, 0.07), (0.06, 0.16, 0.06), (0.42, 0.22, 0.05))
_WALLS: tuple[Vector, ...] = (
    (0.6, 0.5, 0.38),
    (0.42, 0.16, 0.1),
    (0.62, 0.6, 0.56),
    (0.3, 0.34, 0.38),
    (0.6, 0.38, 0.2),
)
_ROOFS: tuple[Vector, ...] = ((0.32, 0.1, 0.06), (0.12, 0.12, 0.13), (0.22, 0.15, 0.1))
_GLASS: Vector = (0.05, 0.07, 0.1)
_LEAVES = (Pattern.CLOUDS, Pattern.MOSAIC)
_PLAIN = (Pattern.PLAIN,)


class Builder(builder.Builder):
    """A builder that also draws materials of given colours."""

    def tinted_material(
        self,
        color: Vector,
        kinds: tuple[Pattern, ...],
        frequency: tuple[float, float],
        other: Vector | None = None,
    ) -> int:
        """Draws a material near ``color`` (linear RGB); its second colour is near ``other`` or a shade of the first."""
        material = self.new_material(kinds, frequency)
        first = np.array(color) * self.rng.uniform(0.75, 1.3) * self.rng.uniform(0.9, 1.1, 3)
        shade = self.rng.uniform(0.5, 0.8) if self.rng.random() < 0.5 else self.rng.uniform(1.25, 1.6)
        second = first * shade if other is None else np.array(other) * self.rng.uniform(0.8, 1.2)
        self.materials[material][3:9] = np.clip([*first, *second], 0.02, 1.0).tolist()
        return material


def pick(b: Builder, colors: tuple[Vector, ...]) -> Vector:
    """Draws one of the colours."""
    return colors[b.rng.integers(len(colors))]


def building(b: Builder, width: float, depth: float, height: float) -> None:
    """Builds a house with its front at x = 0, ``width`` along y and ``depth`` along negative x."""
    rng = b.rng
    windows = b.tinted_material(pick(b, _WALLS), (Pattern.WINDOWS,), (0.22, 0.5), other=_GLASS)
    b.box((-depth / 2, 0, height / 2), (depth, width, height), windows)
    roof = b.tinted_material(pick(b, _ROOFS), (Pattern.BRICKS, Pattern.STRIPES, Pattern.CLOUDS), (1, 3))
    if height < 9 and rng.random() < 0.7:
        # gabled roof: a box standing on its edge, sunk into the house, under two slabs
        edge, slope = depth / np.sqrt(2), np.pi / 4
        b.box((-depth / 2, 0, height), (width, edge, edge), windows, turn=np.pi / 2, tilt=slope)
        for x, tilt in ((-depth / 4, slope), (-3 * depth / 4, -slope)):
            out = np.copysign(0.28, tilt)  # half the overhang along the slope plus half the thickness across it
            b.box((x + out, 0, height + depth / 4 - 0.1), (width + 0.6, edge + 0.5, 0.2), roof, np.pi / 2, tilt)
        if rng.random() < 0.6:
            chimney = (-depth / 2 + rng.uniform(-1, 1), rng.uniform(-0.35, 0.35) * width, height + 0.45 * depth)
            b.box(chimney, (0.7, 0.7, 2.0), b.tinted_material(_WALLS[1], (Pattern.BRICKS,), (2, 5)))
    else:
        b.box((-depth / 2, 0, height + 0.15), (depth + 0.6, width + 0.6, 0.4), roof)
    plinth = b.tinted_material((0.3, 0.29, 0.27), (Pattern.BRICKS, Pattern.CLOUDS, Pattern.PLAIN), (1, 4))
    b.box((-depth / 2, 0, 0.35), (depth + 0.12, width + 0.12, 0.7), plinth)
    door = b.new_material(INDOOR, (1, 6))
    b.box((0.02, rng.uniform(-0.35, 0.35) * width, 1.15), (0.14, rng.uniform(1.0, 2.2), 2.3), door)
    if rng.random() < 0.4:
        _balconies(b, width, height)


def _balconies(b: Builder, width: float, height: float) -> None:
    slab = b.tinted_material((0.5, 0.5, 0.48), _PLAIN, (1, 2))
    rail = b.new_material((Pattern.STRIPES, Pattern.PLAIN, Pattern.PLANKS), (3, 10))
    y = b.rng.uniform(-0.3, 0.3) * width
    for z in np.arange(3.0, height - 1.5, 3.0):
        b.box((0.5, y, z), (1.0, 2.4, 0.14), slab)
        b.box((0.97, y, z + 0.5), (0.05, 2.4, 0.9), rail)


def tree(b: Builder) -> None:
    """Builds a tree with a round crown, or a conifer."""
    rng = b.rng
    bark = b.tinted_material((0.16, 0.1, 0.06), (Pattern.WOOD, Pattern.CLOUDS, Pattern.STRIPES), (2, 8))
    leaves = b.tinted_material(pick(b, GREENS), _LEAVES, (2, 9))
    if rng.random() < 0.3:
        height, radius = rng.uniform(4, 9), rng.uniform(0.8, 1.5)
        b.cylinder((0, 0, 1.0), 0.14, 2.0, bark)
        for level in np.linspace(0, 1, 4):
            size = radius * (1.15 - level)
            b.ellipsoid((0, 0, 2.4 + level * (height - 3)), (size, size, 0.22 * height), leaves)
        return
    trunk = rng.uniform(2.0, 3.2)
    b.cylinder((0, 0, trunk / 2 + 0.3), rng.uniform(0.1, 0.25), trunk + 0.6, bark)
    crown = rng.uniform(1.0, 1.7)
    b.ellipsoid((0, 0, trunk + 0.9 * crown), (crown, crown, crown), leaves)
    for _ in range(rng.integers(3, 8)):
        size = crown * rng.uniform(0.4, 0.7, 3)
        x, y = 0.5 * crown * rng.normal(0, 1, 2).clip(-1.2, 1.2)
        b.ellipsoid((x, y, trunk + crown * rng.uniform(0.6, 1.7)), tuple(size), leaves)


def bush(b: Builder) -> None:
    """Builds a bush of one to four ellipsoids."""
    leaves = b.tinted_material(pick(b, GREENS), _LEAVES, (3, 12))
    for _ in range(b.rng.integers(1, 5)):
        x, y = b.rng.normal(0, 0.25, 2)
        radii = b.rng.uniform(0.25, 0.6, 3)
        b.ellipsoid((x, y, 0.8 * radii[2]), tuple(radii), leaves)


def car(b: Builder) -> None:
    """Builds a car, or a van with probability 1/4; the front points along x."""
    rng = b.rng
    length, width, van = rng.uniform(3.7, 4.7), rng.uniform(1.65, 1.8), rng.random() < 0.25
    hue = rng.uniform(0.03, 0.7, 3) if rng.random() < 0.5 else np.full(3, rng.uniform(0.03, 0.75))
    paint = b.tinted_material(tuple(hue), _PLAIN, (1, 2))
    glass, rubber = b.tinted_material(_GLASS, _PLAIN, (1, 2)), b.tinted_material((0.04, 0.04, 0.04), _PLAIN, (1, 2))
    belt, roof = (1.05, 1.95) if van else (0.82, rng.uniform(1.35, 1.5))
    cabin, middle = (0.92 * length, -0.03) if van else (0.55 * length, -0.06)
    b.box((0, 0, 0.22 + (belt - 0.22) / 2), (length, width, belt - 0.22), paint)
    b.box((middle * length, 0, (belt + roof) / 2), (cabin, width - 0.16, roof - belt), paint if van else glass)
    b.box((middle * length, 0, roof), (0.92 * cabin, width - 0.14, 0.06), paint)
    if van:
        b.box((0.3 * length, 0, (belt + roof) / 2), (0.3 * length, width - 0.12, 0.6 * (roof - belt)), glass)
    else:
        for x in (-0.35, 0.0, 0.45):
            b.box((middle * length + x * cabin, 0, (belt + roof) / 2), (0.07, width - 0.14, roof - belt), paint)
    for x in (-0.31, 0.31):
        b.cylinder((x * length, 0, 0.31), 0.31, width + 0.04, rubber, lying=True)
        b.cylinder((x * length, 0, 0.31), 0.17, width + 0.06, b.tinted_material((0.5, 0.5, 0.5), _PLAIN, (1, 2)), True)
    for x, color in ((0.5, (0.85, 0.85, 0.75)), (-0.5, (0.5, 0.03, 0.03))):
        lamp = b.tinted_material(color, _PLAIN, (1, 2))
        for y in (-0.38, 0.38):
            b.box((x * length, y * width, 0.62), (0.05, 0.25, 0.12), lamp)
        b.box((x * length, 0, 0.36), (0.12, width - 0.1, 0.16), rubber)


def lamp_post(b: Builder) -> None:
    """Builds a street lamp whose arm points along x."""
    height, arm = b.rng.uniform(4, 6.5), b.rng.uniform(0.5, 1.4)
    metal = b.tinted_material((0.14, 0.15, 0.15), (Pattern.PLAIN, Pattern.STRIPES), (1, 4))
    b.cylinder((0, 0, height / 2), 0.07, height, metal)
    b.cylinder((0, 0, 0.35), 0.13, 0.7, metal)
    b.box((arm / 2, 0, height), (arm, 0.07, 0.07), metal)
    b.ellipsoid((arm, 0, height - 0.06), (0.3, 0.14, 0.09), b.tinted_material((0.85, 0.82, 0.7), _PLAIN, (1, 2)))


def sign(b: Builder) -> None:
    """Builds a plate on a pole, facing along x."""
    height, plate = b.rng.uniform(1.9, 2.7), b.rng.uniform(0.35, 0.8, 2)
    b.cylinder((0, 0, height / 2), 0.035, height, b.tinted_material((0.4, 0.4, 0.4), _PLAIN, (1, 2)))
    b.box((0.05, 0, height - plate[1] / 2), (0.03, plate[0], plate[1]), b.new_material(INDOOR, (2, 9)))


def bench(b: Builder) -> None:
    """Builds a bench of slats."""
    wood = b.tinted_material((0.35, 0.2, 0.1), (Pattern.WOOD, Pattern.PLANKS), (2, 6))
    iron = b.tinted_material((0.08, 0.08, 0.08), _PLAIN, (1, 2))
    for x in (-0.18, -0.03, 0.12):
        b.box((x, 0, 0.45), (0.12, 1.7, 0.04), wood)
    for z in (0.62, 0.78):
        b.box((-0.27, 0, z), (0.04, 1.7, 0.11), wood)
    for y in (-0.7, 0.7):
        b.box((0, y, 0.22), (0.4, 0.06, 0.44), iron)
        b.box((-0.3, y, 0.45), (0.05, 0.06, 0.9), iron)


def bin(b: Builder) -> None:
    """Builds a litter bin with a lid."""
    radius, height = b.rng.uniform(0.2, 0.35), b.rng.uniform(0.7, 1.1)
    b.cylinder((0, 0, height / 2), radius, height, b.new_material(INDOOR, (2, 10)))
    b.ellipsoid((0, 0, height), (1.1 * radius, 1.1 * radius, 0.12), b.tinted_material((0.1, 0.1, 0.1), _PLAIN, (1, 2)))


def hoarding(b: Builder) -> None:
    """Builds a poster on two posts, facing along x."""
    width, height = b.rng.uniform(1.5, 3.0), b.rng.uniform(1.0, 1.8)
    post = b.tinted_material((0.25, 0.25, 0.25), _PLAIN, (1, 2))
    for side in (-1, 1):
        b.box((-0.05, side * 0.45 * width, 0.5 + height / 2), (0.08, 0.08, height + 1.0), post)
    b.box((0, 0, 0.8 + height / 2), (0.06, width, height), b.new_material(INDOOR, (0.7, 5)))


def hedge(b: Builder, length: float) -> None:
    """Builds a clipped hedge along y."""
    height, leaves = b.rng.uniform(0.7, 1.8), b.tinted_material(pick(b, GREENS), _LEAVES, (3, 9))
    b.box((0, 0, height / 2), (0.6, length, height), leaves)


def fence(b: Builder, length: float) -> None:
    """Builds a fence of posts and rails along y."""
    height = b.rng.uniform(0.9, 1.5)
    wood = b.tinted_material((0.4, 0.3, 0.2), (Pattern.WOOD, Pattern.PLAIN), (2, 6))
    for y in np.linspace(-length / 2, length / 2, int(length / 1.8) + 2):
        b.box((0, y, height / 2), (0.1, 0.1, height), wood)
    for z in (0.35, 0.65, 0.92):
        b.box((0.06, 0, z * height), (0.04, length, 0.1), wood)


SMALL: tuple[Callable[[Builder], None], ...] = (bush, lamp_post, sign, bench, bin, hoarding)
