"""Intersections and filtered patterns against brute force."""

import numpy as np
import pytest

from tests.kernel_parts import compiled_part
from vg2gt.data.synthetic import raycast, textures
from vg2gt.data.synthetic.furniture import Builder
from vg2gt.data.synthetic.raycast import FAR
from vg2gt.data.synthetic.rooms import SyntheticRoom

intersect_part, leave_walls, nearest_hit, parts_in_cone, surface = (
    compiled_part(getattr(raycast, name))
    for name in ("intersect_part", "leave_walls", "nearest_hit", "parts_in_cone", "surface")
)
pattern_value, pulse_train, square_wave = (
    compiled_part(getattr(textures, name)) for name in ("pattern_value", "pulse_train", "square_wave")
)


def _inside(kind: int, local: np.ndarray, half: np.ndarray) -> np.ndarray:
    x, y, z = np.abs(local / half).T
    if kind == 0:
        return np.maximum(np.maximum(x, y), z) < 1
    if kind == 1:
        return np.maximum(np.hypot(x, y), z) < 1
    return x * x + y * y + z * z < 1


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_parts_are_entered_where_a_march_along_the_ray_enters_them(kind):
    rng = np.random.default_rng(kind)
    steps = np.arange(0.0, 6.0, 2e-4)
    hits = 0
    for _ in range(60):
        builder = Builder(rng)
        builder.place(rng.normal(0, 0.3, 3), rng.uniform(0, 6))
        size = tuple(rng.uniform(0.4, 1.5, 3))
        if kind == 0:
            builder.box((0, 0, 0), size, 0, turn=0.3, tilt=0.4)
        elif kind == 1:
            builder.cylinder((0, 0, 0), size[0], size[1], 0)
        else:
            builder.ellipsoid((0, 0, 0), size, 0)
        parts = np.array(builder.parts)
        origin = rng.normal(0, 1, 3)
        origin *= 3 / np.linalg.norm(origin)
        d = rng.normal(0, 0.6, 3) - origin
        d /= np.linalg.norm(d)
        t = intersect_part(0, parts, *origin, *d)
        local = (origin + steps[:, None] * d - parts[0, :3]) @ parts[0, 4:13].reshape(3, 3).T
        inside = _inside(kind, local, parts[0, 13:16])
        expected = steps[inside.argmax()] if inside.any() else FAR
        assert t == pytest.approx(expected, abs=4e-4) or inside.sum() < 20
        if inside.any():
            hits += 1
            normal = surface(0, parts, *(origin + t * d))[:3]
            assert np.linalg.norm(normal) == pytest.approx(1)
            assert np.dot(normal, d) < 1e-9
    assert hits > 15


def test_bounding_spheres_and_cones_lose_no_hit():
    room = SyntheticRoom(6, 1, (16, 16)).world
    origin = np.array([0.1, 0.2, 1.4])
    every, nowhere_near = np.arange(len(room.parts)), np.zeros(len(room.parts))
    visible, near = np.empty(len(every), np.int64), np.empty(len(every))
    rng = np.random.default_rng(0)
    for _ in range(200):
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        d = axis + rng.normal(0, 0.05, 3)
        d /= np.linalg.norm(d)
        spread = np.arccos(min(1.0, axis @ d)) + 1e-6
        count = parts_in_cone(origin, axis, spread, FAR / 2, room.parts, room.groups, visible, near)
        assert count < len(every)
        assert (np.diff(near[:count]) >= 0).all()
        culled = nearest_hit(visible, near, count, room.parts, room.walls, *origin, *d)
        assert culled == nearest_hit(every, nowhere_near, len(every), room.parts, room.walls, *origin, *d)


@pytest.mark.parametrize("width", [0.01, 0.7, 2.5])
def test_filtered_waves_are_means_of_the_sharp_ones(width):
    rng = np.random.default_rng(1)
    for x in rng.uniform(-3, 3, 20):
        samples = x + width * (np.arange(20000) + 0.5) / 20000 - width / 2
        square = ((samples % 1) < 0.5).mean()
        pulses = (np.abs(samples - np.round(samples)) < 0.15).mean()
        assert square_wave(x, width) == pytest.approx(square, abs=2e-3)
        assert pulse_train(x, 0.3, width) == pytest.approx(pulses, abs=2e-3)
