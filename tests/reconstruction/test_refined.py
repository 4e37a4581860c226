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
from vg2gt.data.sources.sparse_points import ObservedPoints
from vg2gt.data.transforms import resize_images
from vg2gt.geometry.cameras import project, resize_intrinsics, unproject
from vg2gt.inputs.inputs import load_views
from vg2gt.inputs.pictures import Picture, find_pictures
from vg2gt.io import read_cameras_json, read_gaussian_ply, write_cameras_json
from vg2gt.monitor import Monitor
from vg2gt.outputs.saved import read_scene, renderer_of
from vg2gt.reconstruction.frame import SceneFrame
from vg2gt.reconstruction.photographs import full_size, load_photographs, sparse_points
from vg2gt.reconstruction.policy import refined_by_default, refinement_for
from vg2gt.reconstruction.refined import _judged, refine_scene, refinement_lines
from vg2gt.reconstruction.scene import Scene
from vg2gt.refinement import FullSizeOptions, Refined, RefinedScene, RefineOptions, RefineRates
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


def test_kinds_of_cameras_are_told_apart_in_one_place(scene: Scene) -> None:
    described = {"": "PREDICTED", "structure from motion, 4 of 4 images": "FOUND", "RGB-D recording a": "RECORDED"}
    described |= {"COLMAP a": "GIVEN", "poses a": "GIVEN", "cameras.json": "GIVEN"}
    assert {text: replace(scene, cameras_from=text).camera_source.name for text in described} == described


def test_the_summary_says_which_state_is_kept(scene: Scene) -> None:
    state, few = RefinedScene(scene.gaussians, scene.cameras, torch.ones(4, 3), torch.zeros(4, 3)), len(scene.gaussians)
    views, none = torch.arange(4), torch.arange(0)
    psnr = torch.tensor([[20.0] * 4, [25.0] * 4])
    for step, said in ((8, ""), (6, "; the scene after step 6 was the best and is kept"), (0, "; no step was better")):
        refined = Refined(state, state, step, 8, 1.0, "steps", psnr, views, none)
        table, last = refinement_lines(replace(scene, refined=refined))
        assert table == "trained on     4 views:  20.00 ->  25.00 dB"
        assert last.startswith(f"refined for 8 steps{said}")
        assert last.endswith(f"; Gaussians: {few} -> {few}")


def test_photographs_are_refined_unless_asked_not_to(scene: Scene) -> None:
    """Cameras from bundle adjustment stay, predicted ones move; recordings are refined on demand."""
    pictures = tuple(replace(picture, size=(900, 1200)) for picture in scene.pictures)
    photographs = replace(scene, pictures=pictures, cameras_from="structure from motion, 4 of 4 images")
    assert refined_by_default(photographs)
    normal = refinement_for(photographs)
    assert (normal.steps, normal.rates.cameras, normal.min_views) == (240, 0.0, 3)
    assert refinement_for(photographs, "draft").full is None
    normal_full, high_full = normal.full, refinement_for(photographs, "high").full
    assert high_full.steps > 3 * normal_full.steps
    assert refinement_for(photographs, overrides=["refine.full.crop=64"]).full.crop == 64
    alone = refinement_for(replace(photographs, pictures=()))  # no photographs to go on with
    assert (alone.full, alone.steps) == (None, 720)
    assert refinement_for(replace(photographs, pictures=()), overrides=["refine.steps=9"]).steps == 9
    small = replace(photographs, pictures=scene.pictures)
    assert refinement_for(small) == alone
    assert (refinement_for(small).full, refinement_for(small, seconds=9).steps) == (None, None)
    predicted = refinement_for(replace(scene, cameras_from=""), steps=7)
    assert (predicted.steps, predicted.rates.cameras) == (7, RefineRates().cameras)
    recording = replace(scene, cameras_from="RGB-D recording somewhere")
    assert not refined_by_default(recording)
    assert refinement_for(recording, steps=7) == RefineOptions(steps=7)
    with pytest.raises(ValueError, match="choose one of draft, normal, high"):
        refinement_for(photographs, "best")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(("longest", "factor"), [(336, 3), (112, 1)])
def test_photographs_at_their_own_size_are_those_of_the_views(
    photos: Path, scene: Scene, longest: int, factor: int
) -> None:
    """Larger, lying on their side and cropped ones fit their views, pixels and cameras."""
    pictures = sorted(find_pictures(photos), key=lambda picture: picture.name == "IMG_9")  # the large one is last
    pictures = pictures if factor == 1 else pictures[-1:]
    size = scene.cameras.size
    views = load_views(pictures, size, Monitor())
    cameras = scene.cameras.select(torch.arange(len(pictures)))
    found = load_photographs(pictures, cameras, longest, Monitor())
    assert found.size == full_size(pictures, size, longest) == (factor * size[0], factor * size[1])
    back = resize_images(found.images / 255, size)
    assert (back - views.images).abs().mean() < 0.02
    moved = resize_intrinsics(cameras.intrinsics[0], factor, factor)
    torch.testing.assert_close(found.intrinsics, moved, atol=1e-3, rtol=0)


def test_what_is_hardly_usable_is_said_with_its_causes() -> None:
    assert (
        _judged(24.04, 2) == "new views: PSNR of about 24.0 dB, measured on 2 photographs that were left out at first"
    )
    assert "too far apart" in _judged(15.0, 1)


def test_near_plane_and_opacities_are_those_of_the_scene(saved, tmp_path) -> None:
    folder = shutil.copytree(saved, tmp_path / "copy", ignore=shutil.ignore_patterns("refined"))
    assert read_scene(folder, Renderer(near=0.5), torch.device("cpu")).renderer.near == 0.5
    (folder / "report.json").write_text(json.dumps({"near": 0.002}))
    assert read_scene(folder, Renderer(), torch.device("cpu")).renderer.near == 0.002
    (folder / "report.json").write_text(json.dumps({"near": 0.002, "antialiased": True}))
    assert renderer_of(folder, Renderer(mode="rasterized")) == Renderer("rasterized", near=0.002, antialiased=True)
    (folder / "report.json").write_text("[]")  # of another program
    assert renderer_of(folder, Renderer(near=0.5)) == Renderer(near=0.5)


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


def test_points_of_structure_from_motion_are_in_the_scenes_frame(scene: Scene) -> None:
    """Observed in larger, wider pictures whose cameras have another unit, each point is where it was, and once."""
    units, (height, width) = 3.0, scene.cameras.size
    large, numbers = (2 * height, 3 * width), torch.arange(0, scene.depth[0].numel(), 97)
    world = unproject(scene.depth[None], scene.cameras)[0, 0].flatten(0, 1)[numbers]
    pixels, depth = (each[0] for each in project(world.expand(1, len(scene.names), -1, -1), scene.cameras))
    pictures = []
    for view in range(len(scene.names)):
        middle = pixels[view].double() + 0.5  # from the left border of the view; a quarter of the width is cut off
        places = torch.stack(((2 * middle[:, 0] + width / 2) / large[1], 2 * middle[:, 1] / large[0]), 1)
        seen = ((places >= 0) & (places < 1)).all(1) & (depth[view] > 0)
        observed = ObservedPoints(*(each[seen].numpy() for each in (numbers, places, units * depth[view])))
        pictures.append(Picture(scene.names[view], large, lambda size: None, points=observed))  # pyright: ignore
    frame = SceneFrame("reference", np.diag((units, units, units, 1.0)))
    positions, colors = sparse_points(replace(scene, pictures=tuple(pictures), frame=frame))
    assert len(positions) == len(world)
    torch.testing.assert_close(positions, world, rtol=1e-4, atol=1e-4)
    own = scene.images[0].flatten(1).T[numbers]
    assert (colors - own).abs().mean() < 0.1
    assert [len(each) for each in sparse_points(replace(scene, pictures=()))] == [0, 0]


@pytest.mark.parametrize(("longest", "stages"), [(112, 1), (336, 2)])
def test_only_larger_photographs_have_a_second_stage(photos: Path, scene: Scene, longest: int, stages: int) -> None:
    """What is no larger than the working size shows nothing new."""
    large = max(find_pictures(photos), key=lambda picture: max(picture.size))
    pictures = (large,) * len(scene.names)
    options = RefineOptions(steps=2, full=FullSizeOptions(size=longest, steps=1, crop=32))
    found = refine_scene(replace(scene, pictures=pictures), options).refined
    assert (found.sharpened is None) == (stages == 1)
