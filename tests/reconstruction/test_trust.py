"""What a scene says of itself: in files and pictures, and what is left when the worst is dropped."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from tests.data.sources.layout_rgbd import write_recording
from tests.reconstruction.conftest import SIZE, run
from vg2gt.cli import view as view_command
from vg2gt.data import SyntheticScenes
from vg2gt.geometry.cameras import unproject
from vg2gt.io import read_gaussian_ply, write_gaussian_ply
from vg2gt.io.ply import read_properties
from vg2gt.outputs.outputs import write_outputs
from vg2gt.outputs.saved import read_scene
from vg2gt.reconstruction.pipeline import reconstruct_with
from vg2gt.reconstruction.scene import Scene
from vg2gt.reconstruction.trust import pixel_trust, trust_lines, trust_picture, trusted
from vg2gt.rendering import Renderer
from vg2gt.runs import load
from vg2gt.types import Cameras, Geometry, Prediction
from vg2gt.uncertainty import LEVELS, Calibration
from vg2gt.uncertainty.calibration import MEASURED, Curve
from vg2gt.visibility import Status
from vg2gt.visibility.evidence import EVIDENCE


@pytest.fixture(scope="module")
def calibration(ready) -> Calibration:
    """The error is 1 % where depth steps by little, 20 % at edges, whatever else is known."""
    knots = tuple(torch.tensor([-3.0, -2.0]) if name == "step" else torch.zeros(1) for name in EVIDENCE)
    values = tuple(torch.tensor([0.0, 1.0]) if name == "step" else torch.zeros(1) for name in EVIDENCE)
    bounds = torch.tensor([[0.01, 0.2]]) * torch.tensor(LEVELS)[:, None] / 0.9
    curve = Curve(knots, values, torch.tensor([0.0, 1.0]), bounds)
    return Calibration(dict.fromkeys(MEASURED, curve), ready.model.backend.identity()["weights"], 4)


@pytest.fixture(scope="module")
def stated(ready, recording, calibration) -> Scene:
    return reconstruct_with(ready.model, recording, renderer=ready.renderer, calibration=calibration)


@pytest.fixture(scope="module")
def written(stated: Scene, tmp_path_factory) -> Path:
    outputs = ["scene.ply", "cameras.json", "views.npz", "report.json"]
    return write_outputs(stated, tmp_path_factory.mktemp("out"), outputs)


def test_pixels_know_what_supports_them(stated: Scene, scene: Scene) -> None:
    assert stated.support.shape == stated.error.shape == stated.depth.shape
    assert (stated.support == Status.AGREED).float().mean() > 0.6
    assert scene.error is None  # without a calibration
    assert torch.equal(scene.support, stated.support)


def test_it_is_of_the_views_as_they_were_given() -> None:
    depth = torch.full((1, 3, 8, 8), 2.0)
    depth[0, 1, 2, 3] = 0  # the second view that is worked on is the first that was given
    cameras = Cameras(torch.eye(4).repeat(1, 3, 1, 1), torch.eye(3).repeat(1, 3, 1, 1), (8, 8))
    geometry = Geometry(depth, torch.ones_like(depth), cameras, torch.ones(1))
    mask = torch.ones(3, 8, 8)
    mask[2, 7, 7] = 0
    prediction = Prediction(geometry, geometry, torch.ones(1), None, None)
    _, status = pixel_trust(prediction, [2, 0, 1], mask, None)
    assert (status == Status.GUESSED).nonzero().tolist() == [[0, 2, 3]]
    assert (status == Status.UNSEEN).nonzero().tolist() == [[2, 7, 7]]


def test_views_with_cameras_of_others_are_named(ready, tmp_path, caplog) -> None:
    source = SyntheticScenes(1, num_frames=8, size=(84, 112))
    frames = source.load(source.scenes[0], range(8))
    reconstruct_with(ready.model, write_recording(tmp_path, frames, "right"), renderer=ready.renderer)
    assert not caplog.text
    poses = frames.world_to_camera.clone()
    poses[[2, 5]] = poses[[5, 2]]
    swapped = write_recording(tmp_path, replace(frames, world_to_camera=poses), "swapped")
    reconstruct_with(ready.model, swapped, renderer=ready.renderer)
    assert [record.message.split(" contradict")[0] for record in caplog.records] == ["00012, 00015"]


@pytest.mark.parametrize("wrong", [None, "unit", "ray", "inverse", "before", "after"])
def test_measured_depth_that_contradicts_itself_is_said(ready, tmp_path, caplog, wrong: str | None) -> None:
    source = SyntheticScenes(1, num_frames=8, size=SIZE)
    frames = source.load(source.scenes[0], range(8))
    matrix = frames.intrinsics[0]
    x, y = torch.arange(SIZE[1]), torch.arange(SIZE[0])[:, None]
    ray = (1 + ((x - matrix[0, 2]) / matrix[0, 0]) ** 2 + ((y - matrix[1, 2]) / matrix[1, 1]) ** 2).sqrt()
    depth = {
        "unit": frames.depth / 4,
        "ray": frames.depth * ray,
        "inverse": 1 / frames.depth,
        "before": frames.depth.roll(1, 0),
        "after": frames.depth.roll(-1, 0),
    }.get(wrong, frames.depth)
    recording = write_recording(tmp_path, replace(frames, depth=depth))
    reconstruct_with(ready.model, recording, renderer=ready.renderer)
    assert ("the measured depth of most images contradicts" in caplog.text) == (wrong in ("unit", "ray", "inverse"))
    assert (f"is that of the image {wrong} them" in caplog.text) == (wrong in ("before", "after"))
    assert bool(caplog.text) == (wrong is not None)


def test_files_carry_it_and_scenes_of_before_are_read(written: Path, stated: Scene, tmp_path: Path) -> None:
    found = read_properties(written / "scene.ply", "error", "support", "nothing")
    error, status = stated.gaussian_trust["error"], stated.gaussian_trust["support"]
    assert set(found) == {"error", "support"}
    np.testing.assert_allclose(found["error"], error.numpy(), rtol=1e-6)
    np.testing.assert_array_equal(found["support"], status.numpy())
    assert (status == Status.AGREED).float().mean() > 0.3
    back = read_scene(written, Renderer())
    for name in ("error", "support", "depth", "depth_conf"):
        assert torch.equal(getattr(back, name), getattr(stated, name))
    assert (back.images - stated.images).abs().max() <= 0.5 / 255 + 1e-6
    torch.testing.assert_close(back.cameras.world_to_camera, stated.cameras.world_to_camera)
    write_outputs(replace(stated, support=None, error=None), tmp_path, ["scene.ply", "cameras.json", "views.npz"])
    assert read_properties(tmp_path / "scene.ply", "error") == {}
    assert read_scene(tmp_path, Renderer()).support is None


def test_reports_say_it(written: Path, stated: Scene, scene: Scene) -> None:
    trust = json.loads((written / "report.json").read_text())["trust"]
    assert sum(trust["pixels"].values()) == pytest.approx(1, abs=1e-3)
    assert trust["gaussians"]["agreed"] > 0.3
    assert trust["level"] == 0.9
    assert trust["error_of_pixels"] == pytest.approx(0.01, rel=1e-3)
    agreed, single = (100 * trust["gaussians"][name] for name in ("agreed", "single"))
    confirmed, *_, error = trust_lines(stated)
    assert confirmed.startswith(f"Gaussians: {agreed:.0f} % are confirmed by two or more views; ")
    assert f"; {single:.0f} % were seen by one view only (single)" in confirmed
    assert error == "depth error of a typical pixel: at most 1 % (such limits hold for 9 of 10 pixels)"
    assert "no calibration" in trust_lines(scene)[-1]
    lonely = replace(stated, support=torch.full_like(stated.support, Status.SINGLE))
    lonely.__dict__["gaussian_trust"] = {"support": torch.full((len(stated.gaussians),), Status.SINGLE)}
    assert trust_lines(lonely)[0].startswith("Gaussians: 0 % are confirmed")
    assert "take more photographs" in trust_lines(lonely)[1]
    for source, said in (("Nerfstudio room", True), ("structure from motion, 4 of 4 images", False)):
        assert ("--poses sfm" in trust_lines(replace(lonely, cameras_from=source))[1]) == said


def test_what_is_not_trusted_is_left_out(stated: Scene) -> None:
    kept = trusted(stated, 0.95)
    error = kept.gaussian_trust["error"]
    assert len(error) == len(kept.gaussians) < len(stated.gaussians)
    assert error.max() <= 0.05
    assert (kept.depth > 0).sum() < (stated.depth > 0).sum()
    agreed = trusted(stated, drop=["single", "guessed", "contradicted", "unseen"])
    assert (agreed.gaussian_trust["support"] == Status.AGREED).all()
    assert torch.equal(agreed.depth > 0, stated.support == Status.AGREED)
    assert trusted(stated) is stated


def test_impossible_wishes_are_refused(stated: Scene, scene: Scene) -> None:
    unknown = replace(stated, support=None, error=None)
    for of, wish, said in (
        (stated, {"min_confidence": 2}, "--min-confidence 2"),
        (scene, {"min_confidence": 0.9}, "vg2gt calibrate"),
        (stated, {"min_confidence": 1}, "no Gaussian is left"),
        (unknown, {"min_confidence": 0.9}, "reconstruct it again"),
        (unknown, {"drop": ["guessed"]}, "reconstruct it again"),
    ):
        with pytest.raises(ValueError, match=said):
            trusted(of, **wish)


def test_meshes_leave_open_what_no_view_has_measured(stated: Scene, tmp_path: Path) -> None:
    points = unproject(stated.depth[None], stated.cameras)[0]
    center = points[0, 42, 56]
    hole = (points - center).norm(dim=-1) < 0.3
    unknown = replace(stated, depth=torch.where(hole, 0.0, stated.depth))  # its Gaussians are still there
    inside = []
    for name, scene in (("known", stated), ("unknown", unknown)):
        write_outputs(scene, tmp_path / name, ["mesh.ply"])
        vertices = torch.from_numpy(np.array(trimesh.load_mesh(tmp_path / name / "mesh.ply").vertices)).float()
        inside.append(int(((vertices - center).norm(dim=-1) < 0.2).sum()))
    assert inside[0] > 20
    assert inside[1] == 0


def test_the_command_filters_and_the_viewer_colours(recording, calibration, tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(load, "made_for", lambda *_: calibration.made_for)
    path = calibration.write(tmp_path / "c.json")
    run(
        *(recording, "--out", tmp_path / "out", "--save", "scene.ply", "--refine", "0", "--calibration", path),
        *("--drop", "contradicted,unseen", "--min-confidence", "0.95"),
    )
    assert "Gaussians: " in capsys.readouterr().out
    assert read_properties(tmp_path / "out" / "scene.ply", "error")["error"].max() <= 0.05
    support = torch.tensor([Status.AGREED, Status.AGREED, Status.GUESSED, Status.CONTRADICTED, Status.UNSEEN])
    small, large, *unknown = trust_picture(torch.tensor([0.003, 0.3, 1, 1, 1]), support).T
    assert small[2] > small[0]  # blue
    assert large[0] > large[2]  # red
    assert len({tuple(color.tolist()) for color in unknown}) == 3
    coloured = ["--color", "trust", "--html", str(tmp_path / "page.html")]
    view_command.main([str(tmp_path / "out" / "scene.ply"), *coloured])
    assert (tmp_path / "page.html").is_file()
    plain = write_gaussian_ply(tmp_path / "plain.ply", read_gaussian_ply(tmp_path / "out" / "scene.ply"))
    with pytest.raises(SystemExit, match="has no support per Gaussian"):
        view_command.main([str(plain), *coloured])
    with pytest.raises(SystemExit, match="unknown; choose from unseen, guessed"):
        run(recording, "--out", tmp_path / "o", "--drop", "bad")
