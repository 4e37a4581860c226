"""Cameras for a scene file: which part of a split model, and in which frame."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.inputs.test_given_cameras import NAMES, put_cameras, put_colmap
from vg2gt import io
from vg2gt.cli import render as render_command
from vg2gt.inputs.camera_files import read_cameras
from vg2gt.inputs.given_cameras import given_pictures
from vg2gt.inputs.scene_cameras import cameras_of_scene
from vg2gt.io.cameras_json import NamedCamera
from vg2gt.io.colmap import count_images
from vg2gt.reconstruction.pipeline import reconstruct_with
from vg2gt.types import Cameras

MAP = np.array([4_400_000.0, 600_000.0, 300.0])
FILES = ["scene.ply", "cameras.json", "report.json", "color.png"]


def poses_of(cameras: list[NamedCamera]) -> np.ndarray:
    return np.stack([camera.world_to_camera for camera in cameras])


def pictures_of(folder: Path) -> np.ndarray:
    return np.stack([np.array(Image.open(path), float) for path in sorted((folder / "color").iterdir())])


def as_text(model_folder: Path) -> None:
    model = io.read_colmap(model_folder)
    for file in model_folder.iterdir():
        file.unlink()
    model.write_text(model_folder)


@pytest.mark.parametrize("text", [False, True])
def test_the_part_with_most_images_is_read_by_all(folder: Path, frames, caplog, text: bool) -> None:
    """By its images, not by its bytes: the other one has many points in one image and comes first."""
    put_colmap(folder, frames)
    shutil.move(folder / "sparse" / "0", folder / "sparse" / "1")
    one = Cameras(frames.world_to_camera[None, :1].double(), frames.intrinsics[None, :1].double(), (84, 112))
    points = np.random.default_rng(0).uniform(1, 2, (9000, 3))
    seen = np.arange(9000), np.zeros(9000, int), np.random.default_rng(1).uniform(0, 80, (9000, 2))
    io.write_colmap(folder / "sparse" / "0", io.colmap_from_views(one, NAMES[:1], points, sources=seen))
    if text:
        as_text(folder / "sparse" / "0")
        as_text(folder / "sparse" / "1")
    assert [count_images(folder / "sparse" / part) for part in "01"] == [1, 4]
    given = given_pictures(folder) or []
    for place in (folder, folder / "sparse"):
        caplog.clear()
        read = read_cameras(place)
        assert [camera.name for camera in read] == NAMES == [f"{picture.name}.png" for picture in given]
        np.testing.assert_allclose(poses_of(read), np.stack([picture.pose for picture in given]))
        assert "sparse/1 is its largest COLMAP model; ignored" in caplog.text
    assert [camera.name for camera in read_cameras(folder / "sparse" / "0")] == NAMES[:1]  # as asked for


def test_cameras_of_the_source_render_what_those_of_the_scene_do(folder: Path, frames, model, tmp_path, caplog) -> None:
    """A scene shifted from map coordinates: with unmoved cameras its images were of one colour."""
    poses = frames.world_to_camera.double().clone()
    left, _, right = torch.linalg.svd(poses[:, :3, :3])
    poses[:, :3, :3] = left @ right  # a rotation rounded to single precision is centimetres off at map coordinates
    poses[:, :3, 3] -= poses[:, :3, :3] @ torch.from_numpy(MAP)
    put_cameras(folder, replace(frames, world_to_camera=poses))
    scene = reconstruct_with(model, folder)
    scene.save(tmp_path / "out", FILES)
    moved = scene.named_cameras()
    own, source = tmp_path / "out" / "cameras.json", folder / "cameras.json"
    unnamed = [replace(camera, name=f"path-{i}.png") for i, camera in enumerate(io.read_cameras_json(source))]
    io.write_cameras_json(tmp_path / "path.json", unnamed)
    for cameras, said in ((own, False), (source, True), (tmp_path / "path.json", True)):
        caplog.clear()
        found = cameras_of_scene(read_cameras(cameras), tmp_path / "out" / "scene.ply", scene.gaussians)
        np.testing.assert_allclose(poses_of(found), poses_of(moved), atol=1e-5)
        assert ("are moved into that of" in caplog.text) == said
    out = ["--out", str(tmp_path / "views"), "--quiet", "--device", "cpu"]
    render_command.main([str(tmp_path / "out" / "scene.ply"), "--cameras", str(source), *out])
    assert np.abs(pictures_of(tmp_path / "views") - pictures_of(tmp_path / "out")).max() <= 1
    assert pictures_of(tmp_path / "views").std() > 10
    (tmp_path / "alone").mkdir()
    shutil.copy(tmp_path / "out" / "scene.ply", tmp_path / "alone")
    with pytest.raises(SystemExit, match=r"scene sizes away from .*another frame"):
        render_command.main([str(tmp_path / "alone" / "scene.ply"), "--cameras", str(source), *out, "--overwrite"])
    io.write_cameras_json(own, [replace(camera, similarity=None) for camera in moved])  # report.json has it as well
    found = cameras_of_scene(read_cameras(source), tmp_path / "out" / "scene.ply", scene.gaussians)
    np.testing.assert_allclose(poses_of(found), poses_of(moved), atol=1e-5)


def test_cameras_found_are_turned_upright_with_the_scene(folder: Path, frames, model, tmp_path, monkeypatch) -> None:
    """A scene of structure from motion is written upright, its model in OUT/sfm is not."""
    tilt = torch.eye(4)[None].double()
    tilt[:, :3, :3] = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.7, 0.3], [0.7, 0, 0.9], [-0.3, -0.9, 0]]).double())
    put_colmap(folder, replace(frames, world_to_camera=(frames.world_to_camera.double() @ tilt).float()))
    monkeypatch.setattr("vg2gt.inputs.camera_source.SFM_SOURCE", "COLMAP")
    scene = reconstruct_with(model, folder)
    scene.save(tmp_path, FILES[:3])
    assert scene.frame.name == "upright"
    moved = scene.named_cameras()
    found = cameras_of_scene(read_cameras(folder / "sparse"), tmp_path / "scene.ply", scene.gaussians)
    assert np.abs(poses_of(found) - poses_of(read_cameras(folder))).max() > 0.5
    np.testing.assert_allclose(poses_of(found), poses_of(moved), atol=2e-4)
    path = tmp_path / "path.json"  # of the viewer, near one view: in the scene's frame
    io.write_cameras_json(path, [replace(moved[1], name="path-1.png")])
    np.testing.assert_array_equal(
        poses_of(cameras_of_scene(read_cameras(path), tmp_path / "scene.ply", scene.gaussians)), poses_of(moved[1:2])
    )
