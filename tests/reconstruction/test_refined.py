"""Refined scenes: in Python, by both commands, in their reports, and what the commands say of unfit folders."""

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from vg2gt.cli import main
from vg2gt.cli.reconstruct import _refinement
from vg2gt.io import read_cameras_json, read_gaussian_ply, write_cameras_json
from vg2gt.outputs.saved import near_of, read_scene
from vg2gt.reconstruction.scene import Scene
from vg2gt.refinement import RefineOptions, RefineRates
from vg2gt.rendering import Renderer

ORACLE = ["backend=oracle", "backend.depth_noise=0.02", "--quiet", "--device", "cpu"]


def vg2gt(monkeypatch: pytest.MonkeyPatch, *words: str) -> None:
    monkeypatch.setattr(sys, "argv", ["vg2gt", *words])
    main()


@pytest.fixture(scope="module")
def saved(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("saved") / "room"
    scene.save(folder, ["scene.ply", "cameras.json", "views.npz"])
    return folder


def test_the_command(saved: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    options = ["--steps", "8", "--holdout", "4", "refine=default", "refine.check_every=4"]
    vg2gt(monkeypatch, "refine", str(saved), *options, "--quiet", "--device", "cpu")
    printed = capsys.readouterr().out
    assert "trained on     3 views:" in printed
    assert "held out       1 views:" in printed
    out = saved / "refined"
    figures = json.loads((out / "report.json").read_text())["refinement"]
    assert figures["psnr_trained_after"] > figures["psnr_trained_before"]
    assert (figures["steps"], figures["ended"]) == (8, "steps")
    assert len(read_gaussian_ply(out / "scene.ply")) == figures["gaussians_after"]
    first, second = (read_cameras_json(folder / "cameras.json") for folder in (saved, out))
    assert np.allclose(first[0].world_to_camera, second[0].world_to_camera)
    assert not np.allclose(first[1].world_to_camera, second[1].world_to_camera, atol=1e-7)
    again = ["refine", str(out), "--seconds", "0.1", "--quiet", "--device", "cpu"]
    vg2gt(monkeypatch, *again)  # a refined folder is one too
    with pytest.raises(SystemExit, match="already exists"):
        vg2gt(monkeypatch, *again)


def test_photographs_are_refined_unless_asked_not_to(scene: Scene) -> None:
    """Cameras from bundle adjustment stay, predicted ones move; recordings are refined on demand, as before."""
    photographs = replace(scene, cameras_from="structure from motion, 4 of 4 images")
    by_default = _refinement(photographs, None)
    assert (by_default.steps, by_default.rates.cameras, by_default.min_views) == (400, 0.0, 3)
    assert _refinement(photographs, 0) is None
    predicted = _refinement(replace(scene, cameras_from=""), 7)
    assert (predicted.steps, predicted.rates.cameras) == (7, RefineRates().cameras)
    recording = replace(scene, cameras_from="RGBDFolder somewhere")
    assert _refinement(recording, None) is None
    assert _refinement(recording, 7) == RefineOptions(steps=7)


def test_the_near_plane_is_that_of_the_scene(saved, tmp_path) -> None:
    folder = shutil.copytree(saved, tmp_path / "copy", ignore=shutil.ignore_patterns("refined"))
    assert read_scene(folder, Renderer(near=0.5), torch.device("cpu")).renderer.near == 0.5
    (folder / "report.json").write_text(json.dumps({"near": 0.002}))
    assert read_scene(folder, Renderer(), torch.device("cpu")).renderer.near == 0.002
    (folder / "report.json").write_text("[]")  # of another program
    assert near_of(folder, 0.5) == 0.5


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        ("missing", "has no views.npz: give a folder that vg2gt reconstruct has written"),
        ("shape", r"does not belong to the 4 cameras of 84x112 .*depth \(3, 84, 112\)"),
        ("other", "views.npz: it is of other images than cameras.json next to it"),
        ("sizes", "has cameras of 2 sizes"),
        ("option", "Could not override 'refine.rats.sh'"),
        ("value", "refine.holdout must be at least 2"),
    ],
)
def test_mistakes_are_one_line(saved, damage, said, tmp_path, monkeypatch):
    folder = shutil.copytree(saved, tmp_path / "copy", ignore=shutil.ignore_patterns("refined"))
    if damage == "missing":
        (folder / "views.npz").unlink()
    elif damage == "shape":
        arrays = dict(np.load(folder / "views.npz"))
        np.savez(folder / "views.npz", **arrays | {"depth": arrays["depth"][:3]})
    elif damage == "other":
        arrays = dict(np.load(folder / "views.npz"))
        np.savez(folder / "views.npz", **arrays | {"names": arrays["names"][::-1]})
    elif damage == "sizes":
        cameras = read_cameras_json(folder / "cameras.json")
        write_cameras_json(folder / "cameras.json", [replace(cameras[0], width=10), *cameras[1:]])
    words = {"option": ["refine=default", "refine.rats.sh=1"], "value": ["--holdout", "1"]}.get(damage, [])
    with pytest.raises(SystemExit, match=said):
        vg2gt(monkeypatch, "refine", str(folder), "--steps", "1", "--quiet", "--device", "cpu", *words)
