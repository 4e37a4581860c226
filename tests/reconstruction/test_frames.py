"""The frame and unit of what is written, and cameras that people bring."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.geometry.test_geodesy import on_earth, with_gps
from tests.inputs.test_given_cameras import put_cameras, put_colmap
from tests.reconstruction.conftest import SIZE, run
from vg2gt import io
from vg2gt.cli import place
from vg2gt.geometry.cameras import project
from vg2gt.inputs.given_cameras import given_pictures
from vg2gt.io.cameras_json import invert_pose
from vg2gt.outputs.saved import read_scene
from vg2gt.reconstruction.frame import upright_rotation
from vg2gt.reconstruction.pipeline import reconstruct_with
from vg2gt.rendering import Renderer


def test_given_cameras_keep_their_frame_and_unit(folder: Path, frames, tmp_path: Path) -> None:
    put_colmap(folder, frames)
    given = {picture.name: picture.pose for picture in given_pictures(folder) or []}
    run(folder, "--out", tmp_path / "out", "--save", "cameras.json,scene.ply,report.json,views.npz", "--refine", "2")
    for camera in io.read_cameras_json(tmp_path / "out" / "cameras.json"):
        np.testing.assert_allclose(camera.world_to_camera, given[Path(camera.name).stem], atol=1e-6)
        np.testing.assert_allclose(camera.similarity, np.eye(4), atol=1e-5)
    assert json.loads((tmp_path / "out" / "report.json").read_text())["frame"] == "given"
    scene = read_scene(tmp_path / "out", Renderer())
    assert scene.frame.name == "given"
    # Gaussians project to where the decoded depth is: means, cameras and depth moved together.
    pixels, depth = project(scene.gaussians.means[None, None], scene.cameras.select(slice(0, 1)))
    inside = (depth[0, 0] > 0) & (pixels[0, 0] >= 0).all(-1) & (pixels[0, 0] < torch.tensor(SIZE[::-1])).all(-1)
    assert inside.float().mean() > 0.2


def test_the_upright_frame_goes_into_the_given_one(folder: Path, frames, model, monkeypatch) -> None:
    """As the frame's similarity says; found cameras are written upright."""
    put_colmap(folder, frames)
    given = reconstruct_with(model, folder)
    monkeypatch.setattr("vg2gt.inputs.camera_source.SFM_SOURCE", "COLMAP")
    scene = reconstruct_with(model, folder)
    assert scene.frame.name == "upright"
    to_given = torch.from_numpy(scene.frame.to_source).float()
    means = scene.gaussians.means @ to_given[:3, :3].T + to_given[:3, 3]
    torch.testing.assert_close(means, given.gaussians.means, atol=2e-4, rtol=0)
    scale = float(torch.linalg.det(to_given[:3, :3]) ** (1 / 3))
    torch.testing.assert_close(scene.gaussians.scales * scale, given.gaussians.scales, atol=1e-6, rtol=1e-3)
    torch.testing.assert_close(scene.depth * scale, given.depth, atol=1e-5, rtol=1e-4)
    down = scene.cameras.world_to_camera[0, :, 1, :3].mean(0)
    assert down[1] / down.norm() > 0.9
    assert scene.metres_per_unit is None


def test_metric_cameras_give_metres(recording: Path, ready, monkeypatch) -> None:
    scene = reconstruct_with(ready.model, recording)
    assert scene.metres_per_unit == pytest.approx(1)
    monkeypatch.setattr("vg2gt.inputs.camera_source.SFM_SOURCE", "RGB-D recording")
    upright = reconstruct_with(ready.model, recording)
    assert upright.metres_per_unit == pytest.approx(upright.frame.scale)
    assert upright.metres_per_unit != pytest.approx(1, abs=0.01)


def test_gps_gives_metres_and_up(folder: Path, frames, tmp_path: Path, monkeypatch, capsys) -> None:
    """Cameras of an aeroplane look down: what they have below them is not gravity."""
    put_colmap(folder, frames)
    monkeypatch.setattr("vg2gt.inputs.camera_source.SFM_SOURCE", "COLMAP")
    centers = invert_pose(frames.world_to_camera.double().numpy())[:, :3, 3]
    to_enu = 37 * Rotation.from_euler("x", 70, degrees=True).as_matrix()  # the room's z is up
    for file, position in zip(sorted((folder / "images").iterdir()), on_earth(centers @ to_enu.T), strict=True):
        with_gps(file, position)
    run(folder, "--out", tmp_path / "out", "--save", "scene.ply,cameras.json,report.json,views.npz")
    assert "GPS of 4 photographs" in capsys.readouterr().out
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    scene = read_scene(tmp_path / "out", Renderer())
    assert scene.frame is not None
    assert scene.frame.world_place is not None
    assert scene.metres_per_unit == pytest.approx(37 * scene.frame.scale, rel=0.01)
    np.testing.assert_allclose(scene.frame.world_place.to_enu, report["gps"]["to_enu"], atol=1e-6)
    np.testing.assert_allclose(report["gps"]["up"], [0, -1, 0], atol=1e-6)
    assert report["gps"]["origin"][0] == pytest.approx(46.84, abs=0.01)
    found = invert_pose(scene.poses.numpy())[:, :3, 3] @ np.array(report["gps"]["to_enu"])[:3, :3].T
    known = centers @ to_enu.T
    np.testing.assert_allclose(found - found[0], known - known[0], atol=0.02 * np.ptp(known))


def test_gps_by_which_the_photographs_are_upside_down_does_not_count(folder: Path, frames, model, caplog) -> None:
    """As with latitude and longitude swapped, or east for west: such positions are mirrored."""
    put_colmap(folder, frames)
    centers = invert_pose(frames.world_to_camera.double().numpy())[:, :3, 3]
    files = sorted((folder / "images").iterdir())
    for is_mirrored in (False, True):
        metres = 37 * centers * ([1, -1, -1] if is_mirrored else [1, 1, 1])  # a mirror turns over what is level
        for file, position in zip(files, on_earth(metres), strict=True):
            with_gps(file, position)
        assert (reconstruct_with(model, folder).metres_per_unit is None) == is_mirrored
        assert ("upside down; are latitude and longitude swapped" in caplog.text) == is_mirrored


def test_gps_without_altitude_is_said(folder: Path, frames, model, caplog) -> None:
    put_colmap(folder, frames)
    for file in sorted((folder / "images").iterdir())[:3]:
        with_gps(file, (46.84, -91.99, np.nan))
    assert reconstruct_with(model, folder).metres_per_unit is None
    assert "the GPS positions of 3 photographs have no altitude" in caplog.text
    assert "too few or too coarse" in caplog.text


def test_map_coordinates_keep_their_digits(folder: Path, frames, model, caplog) -> None:
    """GPS. The shift is left out of what single precision has to hold, and said."""
    shift = np.array([4_400_000.0, 600_000.0, 300.0])
    poses = frames.world_to_camera.double().clone()
    poses[:, :3, 3] -= poses[:, :3, :3] @ torch.from_numpy(shift)
    put_cameras(folder, replace(frames, world_to_camera=poses))
    scene = reconstruct_with(model, folder)
    assert "the scene is written shifted by" in caplog.text
    assert scene.gaussians.means.abs().max() < 1000
    np.testing.assert_allclose(scene.frame.to_source[:3, 3], shift, atol=20)
    for camera, pose in zip(scene.named_cameras(), poses.numpy(), strict=True):
        np.testing.assert_allclose(camera.world_to_camera @ np.linalg.inv(scene.frame.to_source), pose, atol=2e-6 * 4e6)


def test_gravity_is_across_the_cameras_even_if_they_look_down() -> None:
    angles = np.linspace(0, 2, 9)  # part of an orbit, looking down by 40 degrees
    tilt = Rotation.random(random_state=0)
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, :3, :3] = (Rotation.from_euler("yx", np.stack([-angles, 0 * angles - 0.7], 1)) * tilt.inv()).as_matrix()
    assert (upright_rotation(poses) @ tilt.apply([0, 1, 0]))[1] > 0.999


def test_output_in_the_photographs_folder_does_not_become_input(folder: Path, frames, monkeypatch) -> None:
    """Cameras of undistorted images were taken for the distorted originals."""
    put_colmap(folder, frames)
    found = [
        replace(picture, source="structure from motion, 4 of 4 images", lens="unknown")
        for picture in given_pictures(folder) or []
    ]
    shutil.rmtree(folder / "sparse")
    asked = []
    monkeypatch.setattr("vg2gt.inputs.cameras.find_cameras", lambda *_: asked.append(1) or found)
    for number in (1, 2):
        run(folder / "images", "--out", folder / "images", "--save", "cameras.json", "--overwrite")
        assert len(asked) == number


def test_own_cameras_serve_the_original_photographs(folder: Path, frames, tmp_path: Path, monkeypatch) -> None:
    """Also where the working size cut them; a tilde in the output's path is the home folder."""
    put_colmap(folder, frames)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    run(folder, "--out", "~/x", "--save", "cameras.json", "--size", "70x70")
    assert not (tmp_path / "~").exists()
    shutil.rmtree(folder / "sparse")
    shutil.copy(tmp_path / "home" / "x" / "cameras.json", folder)
    loaded = given_pictures(folder)[2].read(SIZE)
    assert loaded.images.shape[-2:] == SIZE
    assert torch.allclose(loaded.intrinsics[0], frames.intrinsics[2], atol=1e-3)
    assert torch.allclose(loaded.world_to_camera[0], frames.world_to_camera[2], atol=1e-6)


def test_two_points_or_control_points_place_a_scene(folder: Path, frames, tmp_path: Path, capsys) -> None:
    put_colmap(folder, frames)
    out = tmp_path / "out"
    run(folder, "--out", out, "--save", "cameras.json,scene.ply,report.json,views.npz")
    place.main([str(out), "--scale", "0,0,1,0.3,0.4,1=120cm"])
    assert "is 2.4 m" in capsys.readouterr().out
    assert read_scene(out, Renderer()).metres_per_unit == pytest.approx(2.4)
    assert json.loads((out / "report.json").read_text())["metres_per_unit"] == pytest.approx(2.4)
    for wrong in ("0,0,1=1m", "0,0,1,0,0,1=1m", "0,0,1,0,0,2=1", "0,0,1,0,0,2=-1m", "0,0,1,0,0,nan=1m"):
        with pytest.raises(SystemExit):
            place.main([str(out), f"--scale={wrong}"])
    place.main([str(out), "--scale", "-.5,0,0,1,0,0=3m"])
    assert "is 2 m" in capsys.readouterr().out
    points = np.array([[0, 0, 0], [4, 0, 0], [0, 0, 5], [4, 1, 5.0]])
    to_enu = 11 * Rotation.from_euler("x", -90, degrees=True).as_matrix()
    np.savetxt(tmp_path / "control.csv", np.hstack([points, on_earth(points @ to_enu.T)]), delimiter=",", fmt="%.12f")
    place.main([str(out), "--control", str(tmp_path / "control.csv")])
    scene = read_scene(out, Renderer())
    assert scene.metres_per_unit == pytest.approx(11, rel=1e-3)
    assert scene.frame is not None
    assert scene.frame.world_place is not None
    np.testing.assert_allclose(scene.frame.world_place.up, [0, -1, 0], atol=1e-3)
    (tmp_path / "control.csv").write_text("1,2,3,4,5,6\n")
    with pytest.raises(SystemExit, match="three or more"):
        place.main([str(out), "--control", str(tmp_path / "control.csv")])
