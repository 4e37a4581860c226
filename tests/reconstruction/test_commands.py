"""``vg2gt reconstruct`` and ``vg2gt render`` from the command line."""

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.reconstruction.conftest import ORACLE
from vg2gt.cli import reconstruct as reconstruct_command
from vg2gt.cli import render as render_command
from vg2gt.io import read_cameras_json, read_gaussian_ply, write_cameras_json
from vg2gt.io.video import count_frames
from vg2gt.reconstruction.scene import Scene

TINY = ["backend=da3_tiny", "--size", "70", "--quiet", "--device", "cpu"]


def test_photographs_of_all_sizes(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    reconstruct_command.main([str(photos), "--out", str(tmp_path / "out"), *TINY])
    names = {"scene.ply", "cameras.json", "views.npz", "report.png", "report.json"}
    assert {p.name for p in (tmp_path / "out").iterdir()} == names | {"refine.png"}
    figures = json.loads((tmp_path / "out" / "report.json").read_text())
    assert (figures["weights"], figures["backend"]["name"]) == ("none: the head is untrained", "da3_tiny")
    assert set(figures["seconds"]) >= {"load images", "backbone", "decode geometry", "fine voxels", "write files"}
    assert len(read_gaussian_ply(tmp_path / "out" / "scene.ply")) == figures["gaussians"]
    assert len({camera.width for camera in read_cameras_json(tmp_path / "out" / "cameras.json")}) == 1
    printed = capsys.readouterr().out
    assert "4 images of 56x70" in printed
    assert "untrained" in printed
    assert "refining for 400 steps" in printed
    assert "peak memory" in printed


def test_written_scene_renders_to_the_image_in_memory(scene: Scene, tmp_path: Path) -> None:
    scene.save(tmp_path, ["scene.ply", "cameras.json"])
    for mode in ("solid", "rasterized"):
        out = tmp_path / mode
        files = [str(tmp_path / "scene.ply"), "--cameras", str(tmp_path / "cameras.json"), "--out", str(out)]
        save = "color.png,depth.npy,normals.npy,video.gif"
        render_command.main([*files, "--mode", mode, "--save", save, "--quiet", "--device", "cpu"])
        gaussians, cameras = scene.gaussians, scene.cameras
        expected = scene.renderer(gaussians, cameras, mode=mode)
        for i, name in enumerate(scene.names):
            depth = np.load(out / "depth" / f"{name}.npy")
            difference = np.abs(depth - expected.depth[0, i].numpy())
            assert np.quantile(difference, 0.99) < 1e-5
            color = np.array(Image.open(out / "color" / f"{name}.png")) / 255.0
            in_memory = expected.color[0, i].clamp(0, 1).permute(1, 2, 0).numpy()
            assert np.quantile(np.abs(color - in_memory), 0.99) < 1 / 500
            normals = np.load(out / "normals" / f"{name}.npy")
            assert np.quantile(np.abs(normals - expected.normal[0, i].numpy()), 0.99) < 1e-4
        assert count_frames(out / "video.gif") == 4


def test_path_between_cameras_of_mixed_sizes(scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    scene.save(tmp_path, ["scene.spz", "cameras.json"])
    arguments = [str(tmp_path / "scene.spz"), "--cameras", str(tmp_path / "cameras.json"), "--quiet"]
    render_command.main([*arguments, "--out", str(tmp_path / "path"), "--interpolate", "2"])
    assert len(list((tmp_path / "path" / "color").iterdir())) == 10
    assert (tmp_path / "path" / "color" / "008-002.png").is_file()
    cameras = read_cameras_json(tmp_path / "cameras.json")
    k = cameras[1].intrinsics.copy()
    small = type(cameras[1])("small.png", 56, 42, k, cameras[1].world_to_camera)
    write_cameras_json(tmp_path / "cameras.json", [cameras[0], small])
    render_command.main([*arguments, "--out", str(tmp_path / "mixed")])
    assert Image.open(tmp_path / "mixed" / "color" / "small.png").size == (56, 42)
    with pytest.raises(SystemExit, match="one image size"):
        render_command.main([*arguments, "--out", str(tmp_path / "more"), "--interpolate", "2"])


@pytest.mark.parametrize(
    ("names", "said"), [(["a.png", "a.jpg"], "two views are called a;"), (["../a.png", "b.png"], "leads outside")]
)
def test_names_of_views_that_cannot_be_files(names, said: str, scene: Scene, tmp_path: Path) -> None:
    scene.save(tmp_path, ["scene.ply"])
    cameras = [replace(camera, name=name) for camera, name in zip(scene.named_cameras(), names, strict=False)]
    write_cameras_json(tmp_path / "cameras.json", cameras)
    files = [str(tmp_path / "scene.ply"), "--cameras", str(tmp_path / "cameras.json"), "--out", str(tmp_path / "out")]
    with pytest.raises(SystemExit, match=said):
        render_command.main([*files, "--quiet"])
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("nowhere", "nowhere does not exist"),
        ("empty", "no images in .*empty"),
        ("note.txt", r"cannot read \S*note\.txt: .*restore the file or leave it out"),
        ("films", r"no images in .*films .*it contains videos, pass one of them: .*a\.mp4"),
        ("bare.r3d", r"bare\.r3d holds no images"),
        ("note.r3d", r"note\.r3d: not a readable archive"),
        ("broken.png", "cannot read .*broken.png"),
    ],
)
def test_what_holds_no_images_is_told_before_the_weights_are_loaded(tmp_path: Path, name: str, said: str) -> None:
    for folder in ("empty", "films"):
        (tmp_path / folder).mkdir()
    for file in ("note.txt", "note.r3d", "films/a.mp4", "broken.png"):
        (tmp_path / file).write_text("a note")
    zipfile.ZipFile(tmp_path / "bare.r3d", "w").close()
    backend = ["backend=da3_tiny", "backend.pretrained=true", "backend.path=weights-that-are-not-there"]
    with pytest.raises(SystemExit, match=said):
        reconstruct_command.main([str(tmp_path / name), *backend, "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()


def test_output_folder_that_cannot_be_written(photos: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit, match=r"PermissionError: the output folder .*file cannot be made"):
        reconstruct_command.main([str(photos), "--out", str(tmp_path / "file"), *TINY])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "psnr"),
    [("hololens_office_a", 18.0), ("seven_scenes_redkitchen_a_registered", 15.0)],  # the latter registered by estimate
)
def test_real_recordings(name: str, psnr: float, shared: Path, tmp_path: Path) -> None:
    folder = shared / "data" / name
    arguments = [*ORACLE, "--size", "168", "--max-images", "8", "--quiet", "--device", "cpu"]
    save = "scene.ply,cameras.json,color.png,views.npz"
    reconstruct_command.main([str(folder), "--out", str(tmp_path), "--save", save, *arguments])
    errors = []
    images = np.load(tmp_path / "views.npz")["images"]
    for path, image in zip(sorted((tmp_path / "color").iterdir()), images, strict=True):
        rendered, truth = np.array(Image.open(path)) / 255, image / 255
        seen = rendered.sum(-1) > 0.05  # sensors leave holes
        assert seen.mean() > 0.5
        errors.append(-10 * np.log10(np.square(rendered - truth)[seen].mean()))
    assert np.mean(errors) > psnr
