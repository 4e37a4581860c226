"""What the generator's rooms, streets, objects and landmarks are like, and how they shine."""

from dataclasses import replace

import numpy as np
import pytest

from examples.worlds import Worlds
from examples.worlds.orbits import SyntheticLandmark, SyntheticObject, SyntheticWideRoom
from examples.worlds.outdoor import SyntheticOutdoor
from vg2gt.data.synthetic.builder import Builder
from vg2gt.data.synthetic.raycast import AXES, HALF, KIND, PART_COLUMNS
from vg2gt.data.synthetic.renderer import World, render_frame
from vg2gt.data.synthetic.synthetic_scene import level_poses

SIZE = (28, 56)


def places(scene) -> np.ndarray:
    return np.linalg.inv(scene.world_to_camera)[:, :3, 3]


@pytest.mark.parametrize("kind", Worlds.variants.values())
def test_the_seed_decides_the_world_and_highlights_its_colour_alone(kind):
    scene, again, other = kind(3, 4, SIZE), kind(3, 4, SIZE), kind(4, 4, SIZE)
    a, b = scene.render([2], 1)[0], again.render([2], 1)[0]
    assert np.array_equal(a.image, b.image)
    assert np.array_equal(a.depth, b.depth)
    assert not np.array_equal(a.depth, other.render([2], 1)[0].depth)
    shiny = kind(3, 4, SIZE, highlights=True)
    for name in ("parts", "part_materials", "materials", "lights", "walls"):
        assert np.array_equal(getattr(scene.world, name), getattr(shiny.world, name))
    assert np.array_equal(scene.world_to_camera, shiny.world_to_camera)
    brighter = 0
    for a, b in zip(scene.render(range(2), 1), shiny.render(range(2), 1), strict=True):
        assert np.array_equal(a.depth, b.depth)
        assert (b.image.astype(int) - a.image >= -1).all()  # light is added, never taken
        brighter += (b.image > a.image + 3).any(-1).mean()
    assert brighter > 0.001


@pytest.mark.parametrize("kind", [SyntheticObject, SyntheticLandmark, SyntheticWideRoom])
def test_cameras_are_outside_of_everything_and_inside_the_world(kind):
    for seed in range(10):
        scene = kind(seed, 16, SIZE)
        walls, position = scene.world.walls, places(scene)
        assert (position > walls[0] + 0.05).all()
        assert (position < walls[1] - 0.05).all()
        for row in scene.world.parts:
            own = np.abs((position - row[:3]) @ row[AXES:HALF].reshape(3, 3).T) / row[HALF:KIND]
            assert (own.max(1) > 1).all()  # outside of the box around the part


@pytest.mark.parametrize(
    ("kind", "last", "nearest", "sky", "far", "farthest"),
    [(SyntheticOutdoor, 7, 0.5, (0.03, 0.5), 50, 91), (SyntheticLandmark, 5, 1, (0.2, 0.6), 150, 1000)],
)
def test_streets_and_landmarks_have_a_far_background_and_a_sky_without_depth(kind, last, nearest, sky, far, farthest):
    depth = np.array([[frame.depth for frame in kind(seed, 8, SIZE).render([0, last], 1)] for seed in range(8)])
    assert depth[depth > 0].min() > nearest  # nothing is on the camera's path
    assert sky[0] < (depth == 0).mean() < sky[1]
    assert np.median(depth.max((2, 3))) > far
    assert depth.max() < farthest


def test_culling_and_the_sun_lose_no_hit():
    """Every part is hit, and shadowed, as if there were no bounding spheres."""
    scene = SyntheticOutdoor(0, 8, SIZE)
    everything = scene.world.groups.copy()
    everything[:, 3] = 1e6
    plain = replace(scene.world, groups=everything)
    pose = scene.world_to_camera[3]
    culled, full = (render_frame(world, pose, scene.intrinsics, SIZE) for world in (scene.world, plain))
    assert np.array_equal(culled.depth, full.depth)
    assert (culled.image != full.image).mean() < 1e-3  # a ray that grazes two parts


def test_a_point_looks_the_same_from_everywhere_unless_it_shines():
    """The colour of one point of the floor, seen from eight places through a pixel too small to blur anything."""
    builder = Builder(np.random.default_rng(0))
    floor = builder.new_material()
    world = World(
        walls=np.array([[-3.0, -3.0, 0.0], [3.0, 3.0, 3.0]]),
        wall_materials=np.full(6, floor),
        parts=np.empty((0, PART_COLUMNS)),
        part_materials=np.empty(0, np.int64),
        groups=builder.groups(),
        materials=np.array(builder.materials),
        lights=np.array([[1.0, 0.0, 2.0, 0.6, 0.6, 0.6]]),
        ambient=0.3,
    )
    shiny = replace(world, highlights=np.array([[0.5, 20.0]]))
    point, intrinsics = np.array([0.2, 0.1, 0.0]), np.diag([1e6, 1e6, 1.0])
    colors = []  # [8, matt and shiny, 3]
    for angle in np.arange(8) * np.pi / 4:
        eye = point + 1.5 * np.array([np.cos(angle), np.sin(angle), 1.0])
        toward = point - eye
        pan, nod = np.arctan2(toward[1], toward[0]), np.arcsin(toward[2] / np.linalg.norm(toward))
        pose = np.linalg.inv(level_poses(eye[None], np.array([pan]), np.array([nod]))[0])
        seen = [render_frame(each, pose, intrinsics, (1, 1)) for each in (world, shiny)]
        assert seen[0].depth == seen[1].depth == pytest.approx(1.5 * np.sqrt(2), rel=1e-6)
        colors.append([each.image[0, 0].astype(int) for each in seen])
    matt, shining = np.array(colors).swapaxes(0, 1)
    assert np.ptp(matt, axis=0).max() <= 1
    assert np.ptp(shining, axis=0).min() > 20
    assert shining.sum(1).argmax() == 4  # opposite the lamp
