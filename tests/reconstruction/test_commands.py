"""``vg2gt reconstruct`` and ``vg2gt render`` from the command line."""

import json
import zipfile
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vg2gt.cli import reconstruct as reconstruct_command
from vg2gt.cli import render as render_command
from vg2gt.inputs.camera_files import interpolate
from vg2gt.io import read_cameras_json, read_gaussian_ply, write_cameras_json
from vg2gt.io.video import count_frames
from vg2gt.reconstruction.scene import Scene

TINY = ["backend=da3_tiny", "--size", "70", "--quiet", "--device", "cpu"]


def test_photographs_of_all_sizes(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Refined by default, at the working size and then at the photographs' own."""
    fewer = ["refine.steps=20", "refine.full.steps=10", "refine.full.crop=64", "refine.full.size=900"]
    reconstruct_command.main([str(photos), "--out", str(tmp_path / "out"), *TINY, *fewer])
    names = {"scene.ply", "cameras.json", "views.npz", "report.png", "report.json"}
    assert {p.name for p in (tmp_path / "out").iterdir()} == names
    figures = json.loads((tmp_path / "out" / "report.json").read_text())
    assert (figures["weights"], figures["backend"]["name"]) == ("none: the head is untrained", "da3_tiny")
    assert set(figures["seconds"]) >= {"load images", "backbone", "decode geometry", "fine voxels", "write files"}
    assert len(read_gaussian_ply(tmp_path / "out" / "scene.ply")) == figures["gaussians"]
    assert len({camera.width for camera in read_cameras_json(tmp_path / "out" / "cameras.json")}) == 1
    printed = capsys.readouterr().out
    assert "from 4 images, which the model saw at 56x70" in printed
    assert "untrained" in printed
    assert "peak memory" in printed
    assert figures["refinement"]["steps"] == 30
    assert figures["refinement"]["full_size"]["image"] == [90, 112]  # that of most photographs


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


def test_a_path_passes_through_the_cameras(scene: Scene) -> None:
    given = scene.named_cameras()
    path = interpolate(given, 3)
    assert (len(path), path[::4]) == (13, given)
    assert len({camera.name for camera in path}) == 13
    steps = [np.abs(a.world_to_camera - b.world_to_camera).max() for a, b in pairwise(path)]
    assert max(steps) < 0.5 * max(np.abs(a.world_to_camera - b.world_to_camera).max() for a, b in pairwise(given))
    turned = replace(given[0], intrinsics=given[0].intrinsics * [[2], [2], [1]])
    assert interpolate([given[0], turned], 1)[1].intrinsics[0, 0] == pytest.approx(1.5 * given[0].intrinsics[0, 0])
    with pytest.raises(ValueError, match="at least two"):
        interpolate(given[:1], 2)


def test_path_between_cameras_of_mixed_sizes(scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    scene.save(tmp_path, ["scene.spz"])
    first, small = scene.named_cameras()[0], replace(scene.named_cameras()[1], name="small.png", width=56, height=42)
    arguments = [str(tmp_path / "scene.spz"), "--cameras", str(tmp_path / "cameras.json"), "--quiet"]
    write_cameras_json(tmp_path / "cameras.json", scene.named_cameras()[:2])
    render_command.main([*arguments, "--out", str(tmp_path / "path"), "--interpolate", "2"])
    assert {file.name for file in (tmp_path / "path" / "color").iterdir()} >= {"008-001.png", "008-002.png", "009.png"}
    write_cameras_json(tmp_path / "cameras.json", [first, small])
    render_command.main([*arguments, "--out", str(tmp_path / "mixed")])
    assert Image.open(tmp_path / "mixed" / "color" / "small.png").size == (56, 42)
    with pytest.raises(SystemExit, match="one image size"):
        render_command.main([*arguments, "--out", str(tmp_path / "more"), "--interpolate", "2"])


def test_names_of_views_that_cannot_be_files(scene: Scene, tmp_path: Path) -> None:
    scene.save(tmp_path, ["scene.ply"])
    files = [str(tmp_path / "scene.ply"), "--cameras", str(tmp_path / "cameras.json"), "--out", str(tmp_path / "out")]
    for names, said in (("a.png", "a.jpg"), "two views are called a;"), (("../a.png", "b.png"), "leads outside"):
        cameras = [replace(camera, name=name) for camera, name in zip(scene.named_cameras(), names, strict=False)]
        write_cameras_json(tmp_path / "cameras.json", cameras)
        with pytest.raises(SystemExit, match=said):
            render_command.main([*files, "--quiet"])
        assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("nowhere", "nowhere does not exist"),
        ("empty", "no images in .*empty"),
        ("note.txt", r"the only image \S*note\.txt cannot be read \(cannot identify"),
        ("bare.r3d", r"bare\.r3d holds no images"),
        ("note.r3d", r"note\.r3d: not a readable archive"),
        ("broken.png", r"the only image \S*broken\.png cannot be read"),
    ],
)
def test_what_holds_no_images_is_told_before_the_weights_are_loaded(tmp_path: Path, name: str, said: str) -> None:
    (tmp_path / "empty").mkdir()
    for file in ("note.txt", "note.r3d", "broken.png"):
        (tmp_path / file).write_text("a note")
    zipfile.ZipFile(tmp_path / "bare.r3d", "w").close()
    backend = ["backend=da3_tiny", "backend.pretrained=true", "backend.path=weights-that-are-not-there"]
    with pytest.raises(SystemExit, match=said):
        reconstruct_command.main([str(tmp_path / name), *backend, "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()
