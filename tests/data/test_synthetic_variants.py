"""Objects, landmarks and wide rooms of the generator; photographs' exposure, noise and JPEG; upright images."""

import json

import numpy as np
import pytest
import torch

from vg2gt.data import SyntheticScenes
from vg2gt.data.synthetic.export import SceneSettings, missing_scenes, write_scenes
from vg2gt.data.synthetic.orbits import SyntheticLandmark, SyntheticObject
from vg2gt.data.synthetic.photograph import Photograph
from vg2gt.data.synthetic.raycast import AXES, HALF, KIND
from vg2gt.data.synthetic.rooms import SyntheticRoom, SyntheticWideRoom
from vg2gt.data.synthetic.synthetic_scene import LOBES, draw_highlights

from .warping import depth_differences

SIZE = (28, 56)
NEW = (SyntheticObject, SyntheticLandmark, SyntheticWideRoom)


def places(scene):
    return np.linalg.inv(scene.world_to_camera)[:, :3, 3]


@pytest.mark.parametrize("kind", NEW)
def test_cameras_are_outside_of_everything_and_inside_the_world(kind):
    for seed in range(25):
        scene = kind(seed, 16, SIZE)
        walls, position = scene.world.walls, places(scene)
        assert (position > walls[0] + 0.05).all()
        assert (position < walls[1] - 0.05).all()
        for row in scene.world.parts:
            own = np.abs((position - row[:3]) @ row[AXES:HALF].reshape(3, 3).T) / row[HALF:KIND]
            assert (own.max(1) > 1).all()  # outside of the box around the part


@pytest.mark.parametrize("kind", NEW)
def test_the_same_seed_gives_the_same_frames(kind):
    one, two, other = kind(3, 4, SIZE), kind(3, 4, SIZE), kind(4, 4, SIZE)
    a, b = one.render([2], 1)[0], two.render([2], 1)[0]
    assert np.array_equal(a.image, b.image)
    assert np.array_equal(a.depth, b.depth)
    assert one.world.parts.shape != other.world.parts.shape or not np.allclose(one.world.parts, other.world.parts)
    shiny = kind(3, 4, SIZE, True)
    assert np.array_equal(one.world.parts, shiny.world.parts)
    assert np.array_equal(a.depth, shiny.render([2], 1)[0].depth)


@pytest.mark.parametrize("variant", ["object", "landmark", "wide"])
def test_depth_of_one_frame_predicts_another(variant):
    source = SyntheticScenes(1, first_seed=2, num_frames=16, size=(56, 112), variant=variant)
    frames = source.load(source.scenes[0], range(16))
    differences, overlap = depth_differences(frames, 2, 3)
    assert overlap > 0.15
    assert (differences / frames.depth[3][frames.depth[3] > 0].median()).median() < 0.03


def test_objects_are_seen_from_all_around_in_steps_of_10_to_40_degrees():
    steps, turned, open_air = [], [], []
    for seed in range(40):
        scene = SyntheticObject(seed, 24, SIZE)
        position = places(scene)
        angles = np.unwrap(np.arctan2(position[:, 1], position[:, 0]))
        steps.append(np.degrees(np.abs(np.diff(angles))))
        turned.append(np.degrees(abs(angles[-1] - angles[0])))
        open_air.append(scene.world.sky is not None)
    steps = np.concatenate(steps)
    assert steps.min() >= 8
    assert steps.max() <= 48  # a fifth of a step more or less, as a hand does
    assert np.median(turned) > 360
    assert 0.2 < np.mean(open_air) < 0.6


def test_an_object_is_in_the_middle_of_the_picture_and_does_not_fill_it():
    centered, covered = [], []
    for seed in range(20):
        scene = SyntheticObject(seed, 4, (56, 112))
        distance = np.linalg.norm(places(scene)[0])
        depth = scene.render([0], 1)[0].depth
        middle = depth[18:38, 46:66]
        centered.append((middle > 0).any() and middle[middle > 0].min() < distance)
        covered.append(((depth > 0) & (depth < 0.8 * distance)).mean())
    assert np.mean(centered) > 0.9
    assert np.median(covered) < 0.3  # the floor before it included


def test_landmarks_have_a_sky_a_far_background_and_wide_baselines():
    skies, deepest, turned = [], [], []
    for seed in range(12):
        scene = SyntheticLandmark(seed, 8, SIZE)
        position = places(scene)
        angles = np.unwrap(np.arctan2(position[:, 1], position[:, 0]))
        turned.append(np.degrees(abs(angles[-1] - angles[0])))
        frames = scene.render([0, 5], 1)
        skies.append(np.mean([frame.depth == 0 for frame in frames]))
        deepest.append(max(frame.depth.max() for frame in frames))
        assert min(frame.depth[frame.depth > 0].min() for frame in frames) > 1
    assert 0.2 < np.mean(skies) < 0.6
    assert np.median(deepest) > 150
    assert max(deepest) < 1000
    assert np.median(turned) > 70


def test_a_wide_room_is_the_room_of_its_seed_seen_from_all_around():
    spread, narrow = [], []
    for seed in range(8):
        room, wide = SyntheticRoom(seed, 12, SIZE), SyntheticWideRoom(seed, 12, SIZE)
        assert np.array_equal(room.world.parts, wide.world.parts)
        assert np.array_equal(room.world.materials, wide.world.materials)
        narrow.append(np.linalg.norm(np.diff(places(room), axis=0), axis=1).mean())
        spread.append(np.linalg.norm(np.diff(places(wide), axis=0), axis=1).mean())
    assert np.mean(spread) > 5 * np.mean(narrow)


def test_variants_are_options_of_the_source():
    source = SyntheticScenes(4, 0, 1, SIZE, variant=["room", "wide", "object", "landmark"])
    assert list(source.scenes) == ["room-000000", "wide-000001", "object-000002", "landmark-000003"]
    assert isinstance(source.scene("wide-000001"), SyntheticWideRoom)
    with pytest.raises(ValueError, match="variant must be one of room, outdoor, wide, object, landmark"):
        SyntheticScenes(1, variant="orbit")


def test_lobes_are_stronger_and_sharper_than_highlights():
    plain, lobes = draw_highlights((1, 2), 400), draw_highlights((1, 2), 400, LOBES)
    assert np.array_equal(plain[:, 0] > 0, lobes[:, 0] > 0)
    assert lobes[:, 0].max() > 2 * plain[:, 0].max()
    assert lobes[:, 1].max() > 3 * plain[:, 1].max()
    assert lobes[:, 1].min() < plain[:, 1].min()
    with pytest.raises(ValueError, match="highlights must be true, false or lobes; got 'bright'"):
        SyntheticScenes(1, highlights="bright")


def test_upright_images_have_their_field_of_view_upright():
    flat, upright = (SyntheticRoom(1, 2, size) for size in ((28, 56), (56, 28)))
    assert flat.intrinsics[0, 0] == upright.intrinsics[0, 0]
    assert upright.intrinsics[:2, 2].tolist() == [13.5, 27.5]
    frames = SyntheticScenes(1, 1, 2, (56, 28)).load("room-000001", [0])
    assert frames.images.shape == (1, 3, 56, 28)
    assert "upright" in SyntheticScenes(1, 1, 2, (56, 28)).identity("room-000001")


def test_options_that_are_off_leave_names_and_pixels_as_they_were(tmp_path):
    """Caches and published figures hang on them."""
    source = SyntheticScenes(1, 3, 2, SIZE, cache_dir=str(tmp_path))
    assert source.identity("room-000003") == '["SyntheticScenes", "room-000003", 1, [28, 56], 2, false]'
    assert source.cache_file("room-000003") == tmp_path / "rooms-v1-28x56x2" / "room-000003.npz"
    shiny = SyntheticScenes(1, 3, 2, SIZE, highlights=True, cache_dir=str(tmp_path))
    assert shiny.identity("room-000003") == '["SyntheticScenes", "room-000003", 1, [28, 56], 2, true]'
    assert shiny.cache_file("room-000003") == tmp_path / "rooms-highlights-v1-28x56x2" / "room-000003.npz"
    (frame,) = SyntheticRoom(3, 2, SIZE).render([1], 1)
    assert np.array_equal((255 * source.load("room-000003", [1]).images[0]).round().permute(1, 2, 0), frame.image)


def test_exposure_and_jpeg_change_the_image_only(tmp_path):
    levels, ratios = [], []
    for seed in range(12):
        name = f"room-{seed:06d}"
        plain = SyntheticScenes(1, seed, 3, SIZE).load(name, [0, 1, 2])
        source = SyntheticScenes(1, seed, 3, SIZE, exposure=1.5, jpeg=[20, 60], cache_dir=str(tmp_path))
        taken = source.load(name, [0, 1, 2])
        assert torch.equal(plain.depth, taken.depth)
        assert torch.equal(plain.world_to_camera, taken.world_to_camera)
        assert torch.equal(source.load(name, [2]).images[0], taken.images[2])  # from the cache
        (again,) = source.scene(name).render([2], 1)
        assert np.array_equal((255 * taken.images[2]).round().permute(1, 2, 0), again.image)
        light = taken.images.mean((1, 2, 3))
        levels.append(float(light.mean()))
        ratios.append(float(light.max() / light.min()))
    assert min(levels) < 0.25
    assert max(levels) > 0.8
    assert np.median(ratios) < 1.4  # frames of one scene are alike


def test_jpeg_quality_is_that_of_the_range():
    image = SyntheticRoom(3, 1, (56, 112)).render([0], 1)[0].image
    errors = [np.abs(Photograph(jpeg=(q, q)).develop(1, image, 0) - image.astype(float)).mean() for q in (10, 60, 95)]
    assert errors[0] > 1.1 * errors[1] > 1.5 * errors[2] > 0
    assert np.array_equal(Photograph().develop(1, image, 0), image)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"exposure": -1}, "exposure is a standard deviation in stops, at least 0; got -1"),
        ({"jpeg": [95, 30]}, r"jpeg must be null or a range of qualities within \[1, 100\]; got \[95, 30\]"),
        ({"jpeg": [30]}, r"got \[30\]"),
        ({"jpeg": [0, 200]}, r"got \[0, 200\]"),
    ],
)
def test_impossible_photographs_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        SyntheticScenes(1, **options)


def test_folders_written_before_there_were_photographs_are_continued(tmp_path):
    settings = SceneSettings(frames=1, size=(24, 32))
    list(write_scenes(tmp_path, missing_scenes(tmp_path, 1, 0, settings), settings))
    path = tmp_path / "synthetic.json"
    old = json.loads(path.read_text())
    del old["exposure"], old["jpeg"]
    path.write_text(json.dumps(old | {"versions": {"room": 1, "outdoor": 1}}))
    assert missing_scenes(tmp_path, 2, 0, settings) == ["room-000001"]
    with pytest.raises(ValueError, match="jpeg=None instead of"):
        missing_scenes(tmp_path, 2, 0, SceneSettings(frames=1, size=(24, 32), jpeg=[30, 90]))
