"""Every output is read back by its reader and says the same as the scene in memory."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from tests.reconstruction.conftest import run
from vg2gt import io
from vg2gt.data import Frames
from vg2gt.geometry.cameras import project
from vg2gt.io.files import portable
from vg2gt.outputs.output_names import OUTPUTS
from vg2gt.outputs.outputs import write_outputs
from vg2gt.reconstruction.pipeline import reconstruct_with
from vg2gt.reconstruction.scene import Scene
from vg2gt.types import Cameras


@pytest.fixture(scope="module")
def written(scene: Scene, tmp_path_factory) -> Path:
    return write_outputs(scene, tmp_path_factory.mktemp("out") / "new", list(OUTPUTS))


def test_gaussians_and_cameras(written: Path, scene: Scene) -> None:
    folders = {"color", "depth", "normals"}
    names = {name for name in OUTPUTS if name.split(".")[0] not in folders}
    assert {path.name for path in written.iterdir()} == names | folders  # only what was asked
    back = io.read_gaussian_ply(written / "scene.ply")
    for field in ("means", "scales", "opacities"):
        torch.testing.assert_close(getattr(back, field), getattr(scene.gaussians, field), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(io.read_spz(written / "scene.spz").means, scene.gaussians.means, atol=1e-5, rtol=0)
    cameras = io.read_cameras_json(written / "cameras.json")
    assert [camera.name for camera in cameras] == ["008.png", "009.png", "010.png", "011.png"]
    poses = torch.cat([camera.cameras().world_to_camera for camera in cameras], 1)
    assert torch.equal(poses, scene.cameras.world_to_camera)
    assert all((camera.height, camera.width) == scene.cameras.size for camera in cameras)


def test_colmap_points_fall_on_their_pixels_and_have_tracks(written: Path, scene: Scene) -> None:
    model = io.read_colmap(written / "colmap" / "sparse" / "0")
    assert len(model.points3D) > 5000
    lengths = np.array([point.track.length() for point in model.points3D.values()])
    assert lengths.min() >= 1
    assert (lengths >= 2).mean() > 0.5
    for index, image in enumerate(io.colmap_images(model)):
        features = image.get_observation_points2D()
        points = [model.points3D[feature.point3D_id] for feature in features]
        seen = np.array([feature.xy for feature in features])
        pose = io.colmap_pose(image)
        local = np.array([point.xyz for point in points]) @ pose[:3, :3].T + pose[:3, 3]
        pixels = local @ io.colmap_intrinsics(image.camera).T
        assert np.abs(pixels[:, :2] / pixels[:, 2:] + 0.5 - seen).max() < 1e-3
        picture = np.array(Image.open(written / "colmap" / "images" / image.name))
        own = np.abs(seen % 1 - 0.5).max(1) < 1e-3  # the view's own points come from the middle of a pixel
        x, y = (seen - 0.5).round().astype(int).clip(0, [111, 83]).T
        assert own.mean() > 0.2
        assert np.array_equal(picture[y, x][own], np.array([point.color for point in points])[own])
        assert np.abs(local[:, 2] / scene.depth[index, y, x].numpy() - 1).max() < 0.06


def cloud(path: Path) -> np.ndarray:
    points = trimesh.load(path)
    assert isinstance(points, trimesh.PointCloud)
    return np.array(points.vertices)


def test_nerfstudio(written: Path, scene: Scene) -> None:
    transforms = io.read_transforms(written / "nerfstudio" / "transforms.json")
    for frame, camera in zip(transforms.frames, scene.named_cameras(), strict=True):
        assert (written / "nerfstudio" / frame.file_path).is_file()
        assert np.abs(frame.world_to_camera - camera.world_to_camera).max() < 1e-6
        assert np.abs(frame.lens.intrinsics() - camera.intrinsics).max() < 1e-9
    assert len(cloud(written / "nerfstudio" / transforms.ply_file_path)) > 5000


def test_images_larger_than_their_depth_are_exported_at_its_size(recording: Path, ready, tmp_path: Path) -> None:
    folder = shutil.copytree(recording, tmp_path / "recording")
    for path in (folder / "images").iterdir():
        with Image.open(path) as image:
            image.resize((2 * image.width, 2 * image.height)).save(path)
    k = np.loadtxt(folder / "K.txt")
    k[:2] = 2 * k[:2] + [[0, 0, 0.5]]
    np.savetxt(folder / "K.txt", k)
    reconstruct_with(ready.model, folder).save(tmp_path / "out", ["nerfstudio"])
    place = tmp_path / "out" / "nerfstudio"
    for frame in io.read_transforms(place / "transforms.json").frames:
        with Image.open(place / frame.file_path) as image:
            assert image.size == (frame.lens.width, frame.lens.height)


def test_points_and_meshes_lie_on_the_surfaces(written: Path, scene: Scene) -> None:
    points = cloud(written / "points.ply")
    for suffix in ("ply", "glb"):
        assert len(trimesh.load_mesh(written / f"mesh.{suffix}").faces) > 1000
    vertices = torch.from_numpy(np.array(trimesh.load_mesh(written / "mesh.ply").vertices)).float()
    for candidates, tolerance in ((torch.from_numpy(points).float(), 0.01), (vertices, 0.06)):
        pixels, depth = project(candidates[None, None], scene.cameras.select(slice(0, 1)))
        x, y = pixels[0, 0].round().long().unbind(-1)
        seen = (depth[0, 0] > 0) & (x >= 0) & (x < 112) & (y >= 0) & (y < 84)
        surface = scene.depth[0, y[seen], x[seen]]
        error = (depth[0, 0][seen] / surface - 1).abs()[surface > 0]
        assert error.median() < tolerance


def test_reports(written: Path, scene: Scene) -> None:
    assert Image.open(written / "report.png").size == (5 * 112 + 16, 4 * 84 + 12)
    figures = json.loads((written / "report.json").read_text())
    assert (figures["views"], figures["gaussians"]) == (4, len(scene.gaussians))
    assert set(figures["seconds"]) >= {"write files", "render views"}
    assert figures["peak_memory_mib"] > 100


def test_nothing_is_replaced_unasked(written: Path, scene: Scene, tmp_path: Path) -> None:
    with pytest.raises(FileExistsError, match=r"scene.ply already exists"):
        write_outputs(scene, written, ["scene.ply"])
    with pytest.raises(PermissionError, match=r"scene.ply cannot be written to"):
        write_outputs(scene, written / "scene.ply", ["scene.ply"])
    write_outputs(scene, tmp_path, ["color.png"])
    (tmp_path / "color" / "stale.png").touch()
    write_outputs(scene, tmp_path, ["color.png"], overwrite=True)
    assert not (tmp_path / "color" / "stale.png").exists()


def test_two_scenes_in_a_folder_are_said(scene: Scene, tmp_path: Path, caplog) -> None:
    write_outputs(scene, tmp_path, ["scene.ply", "cameras.json", "report.json"])
    write_outputs(scene, tmp_path, ["scene.spz", "report.json"], overwrite=True)
    assert not caplog.messages
    other = replace(scene, names=tuple(f"other-{name}" for name in scene.names), pictures=())
    write_outputs(other, tmp_path, ["scene.spz", "report.json"], overwrite=True)
    assert "holds files of another scene, which later commands mix: scene.ply, cameras.json;" in caplog.text
    caplog.clear()
    write_outputs(other, tmp_path, ["scene.ply", "scene.spz", "cameras.json", "report.json"], overwrite=True)
    assert not caplog.messages


def renamed(folder: Path, frames: Frames, names: list[str]) -> Path:
    """The recording's first photographs under other names, with a COLMAP model."""
    place, count = folder.parent / "renamed", len(names)
    for number, name in enumerate(names):
        (place / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(folder / "images" / f"{8 + number:03d}.png", place / "images" / name)
    poses, intrinsics = (each[None, :count].double() for each in (frames.world_to_camera, frames.intrinsics))
    io.write_colmap(place / "sparse" / "0", io.colmap_from_views(Cameras(poses, intrinsics, (84, 112)), names))
    return place


def test_names_of_244_characters_and_folders_of_cameras_are_kept(folder: Path, frames, model, tmp_path: Path) -> None:
    """As COLMAP allows: files of equal names in the folder of each camera, and names as long as a disk allows."""
    names = ["back/1.png", f"back/{'n' * 240}.png", "front/1.png"]
    rig = renamed(folder, frames, names)
    reconstruct_with(model, rig).save(tmp_path / "out", ["colmap", "nerfstudio", "color.png"])
    images = io.colmap_images(io.read_colmap(tmp_path / "out" / "colmap" / "sparse" / "0"))
    assert [image.name for image in images] == names
    for name in names:
        for kind in ("colmap", "nerfstudio"):
            assert (tmp_path / "out" / kind / "images" / name).read_bytes() == (rig / "images" / name).read_bytes()
    written = io.read_transforms(tmp_path / "out" / "nerfstudio" / "transforms.json").frames
    assert {frame.file_path for frame in written} == {f"images/{name}" for name in names}
    assert (tmp_path / "out" / "color" / Path(names[1]).name).is_file()


def test_files_do_not_replace_each_other_where_case_is_ignored(folder: Path, frames, model, tmp_path: Path) -> None:
    """Windows and macOS: ``IMG_1.png``, ``img_1.png`` and ``IMG_1.PNG``."""
    names = ["IMG_1.png", "img_1.png", "IMG_1.PNG"]
    twins = renamed(folder, frames, names)
    reconstruct_with(model, twins).save(tmp_path / "out", ["colmap", "nerfstudio", "color.png"])
    for place in ("colmap/images", "nerfstudio/images", "color"):
        assert len({path.name.lower() for path in (tmp_path / "out" / place).iterdir()}) == 3
    exported = tmp_path / "out" / "colmap"
    poses = {
        (twins / "images" / name).read_bytes(): pose
        for name, pose in zip(names, frames.world_to_camera.numpy(), strict=False)
    }
    for image in io.colmap_images(io.read_colmap(exported / "sparse" / "0")):
        pose = poses.pop((exported / "images" / image.name).read_bytes())
        np.testing.assert_allclose(io.colmap_pose(image), pose, atol=1e-4)
    assert not poses


def test_names_that_windows_refuses_are_changed(folder: Path, frames, model, tmp_path: Path, caplog) -> None:
    """``photos\\1.png`` is what Linux makes of some ZIP files from Windows."""
    names = ["aux.png", "2024-05-01 12:30.png", "photos\\1.png", "con/NUL.tar.png"]
    odd = renamed(folder, frames, names)
    reconstruct_with(model, odd).save(tmp_path / "out", ["colmap", "nerfstudio", "color.png"])
    images = io.colmap_images(io.read_colmap(tmp_path / "out" / "colmap" / "sparse" / "0"))
    written = ["_aux.png", "2024-05-01 12_30.png", "photos_1.png", "_con/_NUL.tar.png"]
    assert {image.name for image in images} == set(written)
    for name, own in zip(written, names, strict=True):
        for kind in ("colmap", "nerfstudio"):
            assert (tmp_path / "out" / kind / "images" / name).read_bytes() == (odd / "images" / own).read_bytes()
    assert {path.name for path in (tmp_path / "out" / "color").iterdir()} == {Path(name).name for name in written}
    assert "4 names are not allowed on Windows and are changed" in caplog.text
    assert [portable(name) for name in ("a. ", "x.", "com1", "com10.jpg", "console.jpg")] == [
        "a._", "x_", "_com1", "com10.jpg", "console.jpg"
    ]  # fmt: skip


def test_a_full_disk_is_noticed_before_any_work(folder: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 10**9 - 10**6, 10**6))  # type: ignore[attr-defined]
    monkeypatch.setattr("vg2gt.runs.load.build_model", lambda *_: pytest.fail("built a model"))
    with pytest.raises(SystemExit, match=r"has 1 MB left, but at least 2 MB are needed for 4 images"):
        run(folder, "--out", tmp_path / "new" / "out")
    assert not (tmp_path / "new").exists()
