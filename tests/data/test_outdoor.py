"""Outdoor scenes, sky and highlights: exact geometry, and colour that depends on the view only where it should."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.kernel_parts import compiled_part
from tests.training_helpers import small_config
from vg2gt.data import Frames, SyntheticScenes
from vg2gt.data.synthetic.builder import Builder
from vg2gt.data.synthetic.outdoor import SyntheticOutdoor
from vg2gt.data.synthetic.raycast import FAR, PART_COLUMNS, nearest_hit
from vg2gt.data.synthetic.renderer import World, render_frame
from vg2gt.data.synthetic.rooms import SyntheticRoom
from vg2gt.data.synthetic.synthetic_scene import draw_highlights, level_poses
from vg2gt.geometry.cameras import ray_directions
from vg2gt.training.loop import train

from .warping import depth_differences

SIZE = (28, 56)


@pytest.fixture(scope="module")
def streets() -> list[SyntheticOutdoor]:
    return [SyntheticOutdoor(seed, 8, SIZE) for seed in range(12)]


def test_depth_is_far_and_the_sky_has_none(streets):
    skies, deepest = [], []
    for scene in streets:
        for frame in scene.render([0, 7], 1):
            sky = frame.depth == 0
            assert (frame.normal[sky] == 0).all()
            np.testing.assert_allclose(np.linalg.norm(frame.normal[~sky], axis=-1), 1, atol=1e-5)
            assert frame.depth[~sky].min() > 0.5  # nothing stands on the camera's line
            skies.append(sky.mean())
            deepest.append(frame.depth.max())
    assert 0.03 < np.mean(skies) < 0.5
    assert np.median(deepest) > 50
    assert max(deepest) < 91


def test_normals_are_those_of_the_surface(streets):
    scene = SyntheticOutdoor(1, 2, (56, 112))
    frame = scene.render([0], 1)[0]
    rays = ray_directions(torch.from_numpy(scene.intrinsics)[None], (56, 112))[0].numpy()
    points = rays * frame.depth[..., None]
    solid = frame.depth > 0
    assert ((frame.normal * rays).sum(-1)[solid] < 0).all()  # facing the camera
    across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    estimate = np.cross(down, across)
    estimate /= np.maximum(np.linalg.norm(estimate, axis=-1, keepdims=True), 1e-9)
    inner = solid[1:-1, 1:-1] & solid[1:-1, 2:] & solid[1:-1, :-2] & solid[2:, 1:-1] & solid[:-2, 1:-1]
    cosine = (estimate * frame.normal[1:-1, 1:-1]).sum(-1)[inner]
    assert np.median(cosine) > 0.9999
    assert (cosine > 0.999).mean() > 0.5


def test_the_camera_moves_forward_smoothly(streets):
    for scene in streets:
        to_world = np.linalg.inv(scene.world_to_camera)
        step = np.diff(to_world[:, :3, 3], axis=0)
        assert (step[:, 0] > 0).all()
        assert np.linalg.norm(np.diff(step, axis=0), axis=1).max() < 0.5
        ahead = (step[:, None] @ to_world[:-1, :3, 2:3])[:, 0, 0]
        assert (ahead > 0).all()
        turn = np.arccos((to_world[1:, :3, 2] * to_world[:-1, :3, 2]).sum(1).clip(-1, 1))
        assert turn.max() < 0.35


def test_depth_of_one_frame_predicts_the_next():
    source = SyntheticScenes(1, first_seed=3, num_frames=8, size=(56, 112), variant="outdoor")
    frames = source.load("outdoor-000003", range(8))
    differences, overlap = depth_differences(frames, 2, 3)
    assert overlap > 0.5
    assert (differences / frames.depth[3].max()).median() < 0.01


def test_culling_and_the_sun_lose_no_hit(streets):
    """Every part is hit, and shadowed, as if there were no bounding spheres."""
    scene = streets[0]
    everything = scene.world.groups.copy()
    everything[:, 3] = 1e6
    plain = replace(scene.world, groups=everything)
    pose = scene.world_to_camera[3]
    culled, full = (render_frame(world, pose, scene.intrinsics, SIZE) for world in (scene.world, plain))
    assert np.array_equal(culled.depth, full.depth)
    assert (culled.image != full.image).mean() < 1e-3  # a ray that grazes two parts


def test_the_same_seed_gives_the_same_street_and_another_seed_or_variant_another(streets):
    again = SyntheticOutdoor(2, 8, SIZE)
    assert np.array_equal(again.world.parts, streets[2].world.parts)
    a, b = again.render([5], 1)[0], streets[2].render([5], 1)[0]
    assert np.array_equal(a.image, b.image)
    assert np.array_equal(a.depth, b.depth)
    assert len({scene.world.parts.tobytes() for scene in streets}) == len(streets)


def test_variants_take_turns(tmp_path):
    source = SyntheticScenes(5, 1, 2, SIZE, variant=["room", "room", "outdoor"], cache_dir=str(tmp_path))
    assert list(source.scenes) == ["room-000001", "outdoor-000002", "room-000003", "room-000004", "outdoor-000005"]
    assert (source.load("outdoor-000002", [0, 1]).depth == 0).any()
    assert (source.load("room-000003", [0, 1]).depth > 0).all()
    assert len({str(source.cache_file(scene).parent) for scene in source.scenes}) == 2  # pyright: ignore
    for variant in ("space", [], ["room", "space"]):
        with pytest.raises(ValueError, match="variant must be one of room, outdoor"):
            SyntheticScenes(1, variant=variant)


@pytest.mark.parametrize("scene", [SyntheticRoom, SyntheticOutdoor])
def test_highlights_change_nothing_but_colour(scene):
    matt, shiny = scene(4, 6, SIZE), scene(4, 6, SIZE, highlights=True)
    for name in ("parts", "part_materials", "materials", "lights", "walls"):
        assert np.array_equal(getattr(matt.world, name), getattr(shiny.world, name))
    assert np.array_equal(matt.world_to_camera, shiny.world_to_camera)
    brighter = 0
    for a, b in zip(matt.render(range(6), 1), shiny.render(range(6), 1), strict=True):
        assert np.array_equal(a.depth, b.depth)
        assert np.array_equal(a.normal, b.normal)
        assert (b.image.astype(int) - a.image >= -1).all()  # light is added, never taken
        brighter += (b.image > a.image + 3).any(-1).mean()
    assert brighter > 0.01


def test_materials_differ_in_strength_and_roughness():
    highlights = draw_highlights((1, 0), 300)
    assert 0.2 < (highlights[:, 0] == 0).mean() < 0.4
    assert highlights[:, 0].max() < 1
    assert np.quantile(highlights[:, 1], 0.9) > 10 * np.quantile(highlights[:, 1], 0.1) > 0


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
    colors = {"matt": [], "shiny": []}
    for angle in np.arange(8) * np.pi / 4:
        eye = point + 1.5 * np.array([np.cos(angle), np.sin(angle), 1.0])
        toward = point - eye
        pan, nod = np.arctan2(toward[1], toward[0]), np.arcsin(toward[2] / np.linalg.norm(toward))
        pose = np.linalg.inv(level_poses(eye[None], np.array([pan]), np.array([nod]))[0])
        a, b = (render_frame(each, pose, intrinsics, (1, 1)) for each in (world, shiny))
        assert a.depth == b.depth == pytest.approx(1.5 * np.sqrt(2), rel=1e-6)
        colors["matt"].append(a.image[0, 0].astype(int))
        colors["shiny"].append(b.image[0, 0].astype(int))
    assert np.ptp(colors["matt"], axis=0).max() <= 1
    assert np.ptp(colors["shiny"], axis=0).min() > 20
    brightest = int(np.sum(colors["shiny"], axis=1).argmax())
    assert brightest == 4  # opposite the lamp


def test_highlights_have_their_own_cache_and_the_old_rooms_keep_theirs(tmp_path):
    matt, shiny = (SyntheticScenes(1, 0, 2, SIZE, highlights=on, cache_dir=str(tmp_path)) for on in (False, True))
    assert matt.cache_file("room-000000") == tmp_path / "rooms-v1-28x56x2" / "room-000000.npz"
    assert shiny.cache_file("room-000000") != matt.cache_file("room-000000")


def test_sources_are_pickled_and_give_normals_without_sky():
    source = SyntheticScenes(1, 2, 2, SIZE, variant="outdoor")
    frames, normals = source.load("outdoor-000002", [1]), source.normals("outdoor-000002", [1])
    assert isinstance(frames, Frames)
    assert torch.equal(normals.norm(dim=1) == 0, frames.depth == 0)


def test_training_copes_with_the_sky(tmp_path):
    overrides = ["debug=fast_dev_run", "data.variant=outdoor", "data.highlights=true", "backend.background=1.2"]
    for with_background in (overrides[:-1], overrides):
        report = train(small_config(tmp_path / str(len(with_background)), tmp_path / "cache", *with_background))
        assert np.isfinite(list(report["trained"].values())).all()


def test_rays_find_the_ground_or_the_sky(streets):
    world = streets[0].world
    none, near = np.empty(0, np.int64), np.empty(0)
    hit = compiled_part(nearest_hit)
    walls = [
        hit(none, near, 0, world.parts, world.walls, 0.0, 0.0, 1.6, *d)[1]
        for d in ((0.0, 0.0, -1.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    ]
    assert walls == [-5, -6, -2]
    assert hit(none, near, 0, world.parts, world.walls, 0.0, 0.0, 1.6, 0.0, 0.0, -1.0)[0] < FAR
