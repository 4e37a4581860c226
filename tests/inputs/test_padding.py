"""Landscape and portrait together: nothing is cropped away, and padding is no evidence of emptiness."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.inputs.test_given_cameras import NAMES, put_cameras
from vg2gt import io
from vg2gt.data.sources.sparse_points import ObservedPoints
from vg2gt.geometry.cameras import project
from vg2gt.inputs.given_cameras import given_pictures
from vg2gt.inputs.inputs import PADDED, load_views, photo_of, without_padding
from vg2gt.inputs.padding import of_one_shape, padded
from vg2gt.inputs.pictures import Picture
from vg2gt.io.cameras_json import NamedCamera
from vg2gt.monitor import Monitor
from vg2gt.reconstruction.pipeline import reconstruct_with


@pytest.fixture
def mixed(folder: Path, frames) -> Path:
    """Two landscape photographs, and the middle of the two others as portraits of 56x84 pixels."""
    put_cameras(folder, frames)
    cameras = io.read_cameras_json(folder / "cameras.json")
    for view in (2, 3):
        with Image.open(folder / "images" / NAMES[view]) as image:
            image.crop((28, 0, 84, 84)).save(folder / "images" / NAMES[view])
        matrix = cameras[view].intrinsics.copy()
        matrix[0, 2] -= 28
        cameras[view] = replace(cameras[view], width=56, intrinsics=matrix)
    io.write_cameras_json(folder / "cameras.json", cameras)
    return folder


def test_nothing_is_cropped_and_cameras_fit(mixed: Path, frames) -> None:
    pictures = given_pictures(mixed) or []
    whole, size = of_one_shape(pictures, 14, "cpu")
    views = load_views(whole, size, Monitor())
    assert views.mask is not None
    for view, picture in enumerate(pictures):
        seen = views.mask[view] > 0.5
        shown = seen.float().mean().item() * size[0] * size[1] * picture.size[0] * picture.size[1]
        scale = min(size[0] / whole[view].size[0], size[1] / whole[view].size[1])
        assert shown / (picture.size[0] * picture.size[1]) ** 2 == pytest.approx(scale**2, rel=0.06)
    # a point of the middle of each photograph is in its middle, and has its colour there
    point = torch.tensor([[[[0.0, 0, 2]]]])
    for view, picture in enumerate(pictures):
        camera = views.hints.cameras.select(slice(view, view + 1))
        pose = replace(camera, world_to_camera=torch.eye(4)[None, None])
        (x, y) = project(point, pose)[0][0, 0, 0].tolist()
        frame = picture.read(picture.size)
        own = replace(pose, intrinsics=frame.intrinsics[None], size=picture.size)
        (u, v) = project(point, own)[0][0, 0, 0].tolist()
        reach = round(6 * min(size[0] / whole[view].size[0], size[1] / whole[view].size[1]))
        color = views.images[view, :, round(y) - reach : round(y) + reach + 1, round(x) - reach : round(x) + reach + 1]
        expected = frame.images[0, :, round(v) - 6 : round(v) + 7, round(u) - 6 : round(u) + 7]
        assert (color.mean((1, 2)) - expected.mean((1, 2))).abs().max() < 0.04
        named = NamedCamera("a", size[1], size[0], camera.intrinsics[0, 0].double().numpy(), np.eye(4))
        photo = photo_of(named, whole[view])
        assert (photo.height, photo.width) == picture.size
        np.testing.assert_allclose(photo.intrinsics, frame.intrinsics[0], atol=0.6)


def test_sparse_points_move_with_the_picture() -> None:
    points = ObservedPoints(np.arange(2), np.array([[0.0, 0.0], [0.5, 1.0]]), np.ones(2, np.float32))
    picture = Picture("a", (100, 50), lambda size: None, points=points)  # type: ignore[arg-type]
    found = padded(picture, (84, 112)).points
    assert found is not None
    # 133 pixels wide, 41 of them before the picture
    np.testing.assert_allclose(found.places, [[41 / 133, 0], [66 / 133, 1]], atol=1e-6)


def test_the_scene_goes_on_behind_the_padding(mixed: Path, model, tmp_path: Path) -> None:
    scene = reconstruct_with(model, mixed)
    assert scene.mask is not None
    assert ((scene.mask - PADDED).abs() < 1e-6).any()
    assert (without_padding(scene.mask) > 0.999).float().mean() > 0.95  # but for the padding's edge
    assert (scene.depth[scene.mask < 0.5] == 0).all()
    scene.save(tmp_path / "out", ["colmap"])
    sizes = {file.name: Image.open(file).size for file in (tmp_path / "out" / "colmap" / "images").iterdir()}
    assert sizes == {name: (112, 84) if number < 2 else (56, 84) for number, name in enumerate(NAMES)}
