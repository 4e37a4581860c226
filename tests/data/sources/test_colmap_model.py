"""COLMAP scenes: a real model, which cameras are refused, reduced images, absent images, points."""

from dataclasses import replace
from shutil import copytree

import numpy as np
import pytest
from PIL import Image

from vg2gt.data import DataError
from vg2gt.data.sources import COLMAP
from vg2gt.io import ColmapCamera, read_colmap, write_colmap

from .layout_colmap import POINTS_A_VIEW, write
from .layouts import SIZE, room


@pytest.fixture(scope="module")
def statue(shared):
    return shared / "data" / "colmap_statue"


def test_real_model_reprojects(statue):
    """The README's 0.25 px median, through the loader's poses and intrinsics; frames of 23 different sizes load."""
    source = COLMAP(str(statue / "dense"), depth="points")
    (scene,) = source.scenes
    index = source.scene_index(scene)
    assert len(index.frame_ids) == 23
    model = read_colmap(statue / "dense" / "0" / "sparse")
    rows = {number: row for row, number in enumerate(model.points.ids.tolist())}
    errors = []
    for row, image in enumerate(sorted(model.images.values(), key=lambda image: image.name)):
        seen = image.point3d_ids >= 0
        points = model.points.positions[[rows[number] for number in image.point3d_ids[seen].tolist()]]
        pose = index.world_to_camera[row]
        projected = (points @ pose[:3, :3].T + pose[:3, 3]) @ index.intrinsics[row].T
        # The features' own convention has the first pixel's centre at 1/2.
        errors.append(np.linalg.norm(projected[:, :2] / projected[:, 2:] + 0.5 - image.points2d[seen], axis=1))
    assert np.median(np.concatenate(errors)) == pytest.approx(0.25, rel=0.1)

    frames = source.load(scene, [0, 22])
    assert frames.images.shape[-2:] == index.size
    assert abs(index.size[0] - 658) < 10
    assert abs(index.size[1] - 1000) < 10
    assert 50 < int((frames.depth[0] > 0).sum()) < 1443
    assert not source.is_metric


def test_real_distorted_model_is_refused(statue, tmp_path):
    copytree(statue / "sparse", tmp_path / "sparse")
    source = COLMAP(str(tmp_path))
    with pytest.raises(DataError, match=r"SIMPLE_RADIAL.*colmap image_undistorter"):
        source.frames(source.scenes[0])


def test_reduced_images_have_reduced_intrinsics(tmp_path):
    frames = room(3)
    write(tmp_path, frames)
    scene = tmp_path / "statue"
    (scene / "images_2" / "left").mkdir(parents=True)
    for path in sorted((scene / "images" / "left").iterdir()):
        with Image.open(path) as image:
            image.reduce(2).save(scene / "images_2" / "left" / path.name)
    index = COLMAP(str(tmp_path), images="images_2").scene_index("statue")
    assert index.size == (15, 20)
    full = frames.intrinsics[0].numpy()
    np.testing.assert_allclose(index.intrinsics[0][0], [full[0, 0] / 2, 0, (full[0, 2] + 0.5) / 2 - 0.5], rtol=1e-6)
    Image.new("RGB", (20, 20)).save(scene / "images_2" / "left" / "000.png")
    with pytest.raises(DataError, match="20x20 pixels, but its camera in the model 40x30"):
        COLMAP(str(tmp_path), images="images_2").scene_index("statue")


def test_absent_images_are_counted_and_keep_the_numbers(tmp_path):
    write(tmp_path, room(4))
    (tmp_path / "statue" / "images" / "left" / "009.png").unlink()
    source = COLMAP(str(tmp_path / "statue"))
    assert tuple(source.frames("statue")) == (0, 2, 3)
    assert source.scene_index("statue").dropped == {"without a colour image": 1}


def test_a_model_without_its_images_says_what_it_expects_where(tmp_path):
    write(tmp_path, room(2))
    (tmp_path / "statue" / "images").rename(tmp_path / "statue" / "photos")
    expected = r"none of the model's 2 images is in .*statue/images; the first is left/\S+, expected at .*data\.images="
    with pytest.raises(DataError, match=expected):
        COLMAP(str(tmp_path / "statue")).frames("statue")
    assert COLMAP(str(tmp_path / "statue"), images="photos").frames("statue") == (0, 1)


def test_images_of_several_sizes_are_cropped_to_one(tmp_path):
    """One camera of another shape: its frame is cut to the common size and points still project into its pixels."""
    frames = room(3)
    write(tmp_path, frames)
    model = read_colmap(tmp_path / "statue" / "sparse" / "0")
    wide = ColmapCamera(2, "PINHOLE", 60, 30, (27.0, 27.0, 30.0, 15.0))
    folder = tmp_path / "statue" / "sparse" / "1"
    write_colmap(folder, replace(model, cameras={**model.cameras, 2: wide}))
    copytree(folder, tmp_path / "statue" / "sparse" / "0", dirs_exist_ok=True)
    Image.new("RGB", (60, 30)).save(tmp_path / "statue" / "images" / "left" / "009.png")
    source = COLMAP(str(tmp_path))
    loaded = source.load("statue", [0, 1])
    assert loaded.images.shape[-2:] == SIZE
    assert loaded.intrinsics[1, 0].tolist() == pytest.approx([27.0, 0, 30 - 0.5 - 10])


def test_points_need_three_views_and_the_nearest_wins(tmp_path):
    write(tmp_path, room(3))
    source = COLMAP(str(tmp_path), depth="points")
    depth = source.load("statue", [0]).depth[0]
    assert 0.7 * POINTS_A_VIEW < int((depth > 0).sum()) <= POINTS_A_VIEW
    folder = tmp_path / "statue" / "sparse" / "0"
    model = read_colmap(folder)
    lengths = np.where(np.arange(len(model.points)) < POINTS_A_VIEW, 2, 3)  # frame 0's own points
    kept = np.concatenate([np.arange(3 * i, 3 * i + length) for i, length in enumerate(lengths)])
    points = replace(model.points, tracks=model.points.tracks[kept], track_lengths=lengths)
    write_colmap(folder, replace(model, points=points))
    source = COLMAP(str(tmp_path), depth="points")
    assert tuple(source.frames("statue")) == (1, 2)
    assert source.scene_index("statue").dropped == {"without a depth file": 1}
    with pytest.raises(ValueError, match="depth must be points"):
        COLMAP(str(tmp_path), depth="dense")
