"""COLMAP scenes: a real model, which cameras are refused, reduced images, absent images, points."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from vg2gt.data import DataError
from vg2gt.data.batches import BatchDataset
from vg2gt.data.sources import COLMAP
from vg2gt.data.sources.parsing import existing_image
from vg2gt.data.sources.undistortion import undistortion_of
from vg2gt.data.transforms import resize_to_cover
from vg2gt.data.views import SceneSample
from vg2gt.evaluation.checks import refuse_without_hints
from vg2gt.geometry.cameras import resize_intrinsics
from vg2gt.io import colmap_from_views, colmap_images, read_colmap, write_colmap
from vg2gt.runs.load import load_model

from .layout_colmap import POINTS_A_VIEW, write
from .layouts import LEFT_HALF, cameras_of, halve, pixels, room, save


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
    errors = []
    for row, image in enumerate(colmap_images(model)):
        features = image.get_observation_points2D()
        points = np.array([model.points3D[feature.point3D_id].xyz for feature in features])
        pose = index.world_to_camera[row]
        projected = (points @ pose[:3, :3].T + pose[:3, 3]) @ index.intrinsics[row].T
        # The features' own convention has the first pixel's centre at 1/2.
        seen = np.array([feature.xy for feature in features])
        errors.append(np.linalg.norm(projected[:, :2] / projected[:, 2:] + 0.5 - seen, axis=1))
    assert np.median(np.concatenate(errors)) == pytest.approx(0.25, rel=0.1)
    frames = source.load(scene, [0, 22])
    assert frames.images.shape[-2:] == index.size
    assert abs(index.size[0] - 658) < 10
    assert abs(index.size[1] - 1000) < 10
    assert 50 < int((frames.depth[0] > 0).sum()) < 1443
    assert not source.is_metric


def distort(folder: Path) -> None:
    model = read_colmap(folder)
    for camera in model.cameras.values():
        fx, _, cx, cy = camera.params
        camera.model, camera.params = "SIMPLE_RADIAL", [fx, cx, cy, 0.02]
    write_colmap(folder, model)


def test_distorted_images_are_undistorted_when_read(tmp_path):
    """Item 16: COLMAP's default camera."""
    frames = room(3)
    write(tmp_path, frames)
    distort(tmp_path / "statue" / "sparse" / "0")
    source = COLMAP(str(tmp_path), depth="points")
    index = source.scene_index("statue")
    assert index.lens(1).startswith("SIMPLE_RADIAL 40 30")
    undistortion = undistortion_of(index.lens(1))
    assert index.own_size(1) == undistortion.size
    assert np.array_equal(index.intrinsics[1], undistortion.intrinsics)
    loaded = source.load_whole("statue", 1)
    expected = undistortion.color(pixels(frames)[1])
    assert np.array_equal(pixels(loaded)[0], expected)
    assert np.abs(expected.mean() - pixels(frames)[1].mean()) < 10
    assert (loaded.depth > 0).sum() > 0.7 * POINTS_A_VIEW


@pytest.mark.parametrize("distorted", [False, True])
def test_large_images_are_reduced_with_their_cameras(tmp_path, distorted: bool, monkeypatch) -> None:
    frames = room(3)
    write(tmp_path, frames)
    if distorted:
        distort(tmp_path / "statue" / "sparse" / "0")
    source = COLMAP(str(tmp_path))
    whole = source.load_whole("statue", 1)
    monkeypatch.setattr("vg2gt.io.image_files._LARGE", 100)
    small = source.load_whole("statue", 1, (7, 10))
    height, width = whole.images.shape[-2:]
    assert small.images.shape[-2:] == (round(height / 2), round(width / 2))
    expected = torch.nn.functional.interpolate(whole.images, small.images.shape[-2:], mode="area")
    error = (small.images - expected).abs().mean()
    assert error < 0.03  # undistorting samples other pixels
    assert all(error < 0.5 * (small.images.roll(1, side) - expected).abs().mean() for side in (-2, -1))
    matrix = resize_intrinsics(whole.intrinsics, small.images.shape[-1] / width, small.images.shape[-2] / height)
    assert torch.allclose(small.intrinsics, matrix, atol=1e-3)


def test_the_larger_model_is_taken_and_the_other_named(tmp_path, caplog):
    """Item 8."""
    frames = room(4)
    write(tmp_path, frames)
    scene = tmp_path / "statue"
    (scene / "sparse" / "0").rename(scene / "sparse" / "1")
    two = cameras_of(frames).select(slice(2))
    write_colmap(scene / "sparse" / "0", colmap_from_views(two, ["left/000.png", "left/009.png"]))
    assert len(COLMAP(str(tmp_path)).frames("statue")) == 4
    assert f"sparse/1 of scene statue is its largest COLMAP model; ignored: {scene}/sparse/0" in caplog.text


@pytest.mark.parametrize(("orientation", "stored"), [(3, True), (6, False), (6, True)])
def test_exif_orientation_with_given_cameras(tmp_path, orientation, stored):
    """Cameras of images as stored, as COLMAP reads them, and of upright ones, if their shape tells."""
    frames = room(1)
    write(tmp_path, frames)
    (path,) = tmp_path.rglob("000.png")
    turn = Image.Transpose.ROTATE_180 if orientation == 3 else Image.Transpose.ROTATE_90
    picture = Image.fromarray(pixels(frames)[0])
    exif = Image.Exif()
    exif[0x0112] = orientation
    (picture if stored else picture.transpose(turn)).save(path, exif=exif)
    loaded = COLMAP(str(tmp_path)).load("statue", [0])
    assert (loaded.images - frames.images).abs().max() < 0.01
    assert torch.allclose(loaded.intrinsics, frames.intrinsics)
    Image.new("RGB", (40, 36)).save(path, exif=exif)
    with pytest.raises(DataError, match=r"40x36 pixels, but its camera in .* is 40x30: use the camera's own"):
        COLMAP(str(tmp_path)).scene_index("statue")


def test_another_camera_of_a_rig_is_no_reduced_copy(tmp_path):
    for place in ("images/cam_1", "other/images_4"):
        save(tmp_path / place / "000.png", np.zeros((30, 40, 3), np.uint8))
    assert existing_image(tmp_path / "images" / "cam" / "000.png") is None
    assert existing_image(tmp_path / "other" / "images" / "000.png") == tmp_path / "other" / "images_4" / "000.png"


def test_reduced_images_have_reduced_intrinsics(tmp_path):
    frames = room(3)
    write(tmp_path, frames)
    halve(tmp_path / "statue" / "images" / "left", tmp_path / "statue" / "images_2" / "left")
    index = COLMAP(str(tmp_path), images="images_2").scene_index("statue")
    assert index.size == (15, 20)
    full = frames.intrinsics[0].numpy()
    np.testing.assert_allclose(index.intrinsics[0][0], [full[0, 0] / 2, 0, (full[0, 2] + 0.5) / 2 - 0.5], rtol=1e-6)


def test_absent_images_are_counted_and_keep_the_numbers_and_without_any_their_place_is_named(tmp_path, caplog):
    write(tmp_path, room(3))
    scene = tmp_path / "statue"
    (scene / "images" / "left" / "009.png").unlink()
    (scene / "images").rename(scene / "photos")
    source = COLMAP(str(scene), images="photos")
    assert source.frames("statue") == (0, 2)
    assert "1 of 3 frames without a colour image are left out" in caplog.text
    expected = r"none of the .* 3 images is in .*statue/images; the first is left/.* or set data\.images to"
    with pytest.raises(DataError, match=expected):
        COLMAP(str(scene)).frames("statue")


def test_points_need_three_views_and_the_nearest_wins(tmp_path, caplog):
    write(tmp_path, room(3))
    source = COLMAP(str(tmp_path), depth="points")
    depth = source.load("statue", [0]).depth[0]
    assert 0.7 * POINTS_A_VIEW < int((depth > 0).sum()) <= POINTS_A_VIEW
    folder = tmp_path / "statue" / "sparse" / "0"
    model = read_colmap(folder)
    for number in range(1, POINTS_A_VIEW + 1):  # frame 0's own points
        other = next(each for each in model.point3D(number).track.elements if each.image_id != 1)
        model.delete_observation(other.image_id, other.point2D_idx)
    write_colmap(folder, model)
    source = COLMAP(str(tmp_path), depth="points")
    assert tuple(source.frames("statue")) == (1, 2)
    assert "1 of 3 frames without a depth file are left out" in caplog.text
    with pytest.raises(ValueError, match="depth must be points"):
        COLMAP(str(tmp_path), depth="dense")


def test_masks_go_with_a_batch_and_take_its_depth_away(tmp_path, caplog):
    """Issue 47, item 7: a folder of masks, partly filled."""
    write(tmp_path, room(4))
    for name in ("000.png", "009.png.png", "018.png"):
        save(tmp_path / "statue" / "masks" / "left" / name, LEFT_HALF)
    whole = COLMAP(str(tmp_path), depth="points").load("statue", range(4))
    assert whole.mask.mean((1, 2)).tolist() == [0.5, 0.5, 0.5, 1]
    assert "1 of 4 images have no mask in" in caplog.text
    assert "left/027.png" in caplog.text
    data = BatchDataset(COLMAP(str(tmp_path), depth="points"), partial(resize_to_cover, size=(28, 42)), 10)
    batch = data[(SceneSample("statue", (0, 1), (2,)),)]
    assert batch.mask is not None
    assert batch.hints.mask is not None
    assert batch.context.mask.shape == (1, 2, 28, 42)
    assert (batch.depth[..., :20] == 0).all()
    assert (batch.depth[..., 22:] > 0).any()
    assert (whole.depth[..., :20] > 0).any()


def test_depth_at_points_is_not_enough_for_a_backend_that_needs_depth(tmp_path):
    """Issue 47, item 2: the oracle was trained on them as if they were a depth camera's."""
    write(tmp_path, room(3))
    source = COLMAP(str(tmp_path), depth="points")
    model = load_model(backend="oracle", device="cpu").model
    with pytest.raises(DataError, match=r"oracle needs the data's depth, and COLMAP has none \(depth at sparse points"):
        refuse_without_hints(model, source)
    refuse_without_hints(load_model(backend="sweep", device="cpu").model, source)
