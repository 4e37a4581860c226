"""The recipe of the plane sweep's weights, and slim rooms."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import DictConfig, OmegaConf
from safetensors import safe_open
from safetensors.torch import save
from torch.nn import functional as F

from backends.sweep.backend import SweepBackend
from backends.sweep.network import SweepEncoding
from backends.sweep.planes import Planes
from backends.sweep.stage import Stage
from backends.sweep.views import baselines
from recipes.infinigen.slim import VIEWS, choose, decode_depth, encode_depth, read_slim, write_slim
from recipes.sweep.__main__ import STATE, WEIGHTS, Training, begun_with
from recipes.sweep.objective import cell_inverse, objective, plane_entropy
from recipes.sweep.samples import Sample, TrainingSamples
from recipes.sweep.scenes import read_scene, scene_files
from tests.commands import ROOT
from tests.data.sources import layout_infinigen
from tests.data.sources.layouts import room
from vg2gt.geometry.cameras import project, unproject
from vg2gt.io.files import write_bytes
from vg2gt.types import Cameras

SHAPES = [(2, 48, 96, 0.5), (12, 32, 64, 0.5)]


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two rooms, an object, a room from all around; rendered when they are first read."""
    return scene_files(tmp_path_factory.mktemp("scenes"), 4, 5_000_000, (64, 128))


def test_scenes_are_rendered_once(tmp_path: Path) -> None:
    (path,) = scene_files(tmp_path, 1, 5_000_000, (48, 96))
    made = read_scene(path)
    assert made.images.shape == (14, 48, 96, 3)
    written = path.stat().st_mtime_ns
    for kept in (read_scene(path), read_scene(*scene_files(tmp_path / "other", 1, 5_000_000, (48, 96)))):
        assert all(torch.equal(a, b) for a, b in zip(made, kept, strict=True))
    assert path.stat().st_mtime_ns == written


def test_views_of_a_sample_see_the_same_points(scenes: list[Path]) -> None:
    """Crop, zoom, mirror, turn and unit change images, depth, poses and intrinsics together."""
    samples = TrainingSamples(scenes, 3, shapes=[(4, 48, 96, 1)])
    agreed, through = [], []
    for sample in (samples[index] for index in range(10)):
        size = (sample.depth.shape[-2], sample.depth.shape[-1])
        cameras = Cameras(sample.world_to_camera[None], sample.intrinsics[None], size)
        points = unproject(sample.depth[None], cameras)[0, 0].reshape(1, 1, -1, 3)
        known = ((sample.depth[0] > 0) & sample.depth[0].isfinite()).flatten()
        for other in range(1, len(sample.depth)):
            pixels, depth = project(points, cameras.select(slice(other, other + 1)))
            u, v, z = pixels[0, 0, :, 0], pixels[0, 0, :, 1], depth[0, 0]
            inside = (z > 0) & (u > 0) & (v > 0) & (u < size[1] - 1) & (v < size[0] - 1) & known
            grid = torch.stack(((2 * u + 1) / size[1] - 1, (2 * v + 1) / size[0] - 1), -1)[None, None]
            there = F.grid_sample(sample.depth[other][None, None], grid, mode="nearest", align_corners=False)
            ratio = there[0, 0, 0] / z
            if inside.sum() > 200:
                agreed.append(float(((ratio - 1).abs() < 0.03)[inside].float().mean()))
                through.append(float((ratio > 1.03)[inside].float().mean()))
    assert len(agreed) > 15
    assert np.median(agreed) > 0.6  # the rest is hidden there
    assert np.median(through) < 0.05  # almost nothing that one view sees is looked through by another


def test_samples_depend_on_their_number_alone(scenes: list[Path]) -> None:
    """From 2 to 12 views; sources are other views; what is hidden or seen by one view only weighs more."""
    samples, again = (TrainingSamples(scenes, 0, shapes=SHAPES) for _ in range(2))
    drawn = [samples[n] for n in range(14)]
    assert all(torch.equal(a, b) for a, b in zip(drawn[7], again[7], strict=True))
    assert {len(sample.images) for sample in drawn} == {2, 12}
    for sample in drawn:
        own = torch.arange(len(sample.images))[:, None]
        assert ((sample.sources != own) & (sample.sources >= 0) & (sample.sources < len(own))).all()
        hidden = (sample.shown[:, 0] == 0).repeat_interleave(8, 1).repeat_interleave(8, 2)
        assert (sample.weight[hidden] == 2).all()
        assert sample.weight.min() >= 1
    orphaned = [sample for sample in drawn if not sample.shown.all()]
    assert 1 <= len(orphaned) <= 7


def test_scenes_without_depth_are_an_error(tmp_path: Path) -> None:
    (path,) = scene_files(tmp_path, 1, 5_000_000, (48, 96))
    frames = read_scene(path)
    empty = frames._replace(depth=torch.zeros_like(frames.depth))
    np.savez(path, **{name: value.numpy() for name, value in empty._asdict().items()})
    with pytest.raises(ValueError, match=rf"100 draws of 2 views, the last from .*{path.name}, have too few pixels"):
        TrainingSamples([path], 0, shapes=[(2, 48, 96, 1)])[0]


def test_views_that_do_not_overlap_can_be_drawn(tmp_path: Path) -> None:
    """A path that turns by 40 degrees a step: views without regard to overlap turn farther from one another."""
    frames, turns = 9, np.deg2rad(40) * np.arange(9)
    poses = torch.eye(4).repeat(frames, 1, 1)
    cosine, sine = torch.from_numpy(np.cos(turns)).float(), torch.from_numpy(np.sin(turns)).float()
    poses[:, 0, 0], poses[:, 0, 2], poses[:, 2, 0], poses[:, 2, 2] = cosine, sine, -sine, cosine
    intrinsics = torch.tensor([[48.0, 0, 47.5], [0, 48, 23.5], [0, 0, 1]]).repeat(frames, 1, 1)
    path = tmp_path / "00000001-48x96.npz"
    arrays = {"images": np.zeros((frames, 48, 96, 3), np.uint8), "depth": np.full((frames, 48, 96), 2, np.float16)}
    np.savez(path, **arrays, world_to_camera=poses.numpy(), intrinsics=intrinsics.numpy())

    def farthest(any_views: float) -> list[float]:
        samples = TrainingSamples([path], 0, shapes=[(4, 32, 64, 1)], any_views=any_views)
        forward = [sample.world_to_camera[:, 2, :3] for sample in (samples[n] for n in range(30))]
        return [float((each @ each.T).min()) for each in forward]

    assert min(farthest(1.0)) < -0.7
    assert np.mean(farthest(1.0)) < np.mean(farthest(0.0)) - 0.2


def slanted(rows: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
    """Inverse depth of a plane, ``[1, H, W]``."""
    return (0.2 + 0.01 * columns + 0.02 * rows[:, None])[None]


def test_cells_know_their_middle() -> None:
    """On a slanted plane inverse depth is linear in the image, so the middle of a cell is known exactly."""
    inverse = slanted(torch.arange(8.0), torch.arange(16.0))
    found, known = cell_inverse(1 / inverse, 4)
    torch.testing.assert_close(found[0], slanted(4 * torch.arange(2.0) + 1.5, 4 * torch.arange(4.0) + 1.5))
    assert known.all()
    hole = (1 / inverse).clone()
    hole[0, 1, 1] = 0
    assert cell_inverse(hole, 4)[1].flatten().tolist() == [0, 1, 1, 1, 1, 1, 1, 1]


@pytest.fixture
def slope() -> tuple[Sample, SweepEncoding]:
    """A slanted plane in two views, and stages that find it exactly."""
    rows, columns = torch.arange(32.0)[:, None], torch.arange(32.0)
    depth = (1 / (0.2 + 0.004 * columns + 0.006 * rows)).expand(2, -1, -1)
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[1, 0, 3] = 0.5
    ones = torch.ones(2, 32, 32)
    sample = Sample(torch.zeros(2, 3, 32, 32), depth, poses, torch.eye(3), torch.zeros(2, 1), ones, ones)
    planes, stages, centers = Planes(baselines(poses)), [], []
    for cell, count, spacing in ((8, 64, 1 / 63), (4, 16, 0.25 / 63), (2, 8, 0.1 / 63)):
        truth = -cell_inverse(depth, cell)[0].log()
        t = planes.position(truth)
        position = torch.arange(count).view(1, -1, 1, 1) * spacing
        if cell < 8:
            position = t + position - position.mean()
        if cell == 4:  # a second row, of nearer planes
            position = torch.cat((position, position + 8 / 63), 1)
        share = (1 - (position - t).abs() / spacing).clamp_min(1e-6)
        stages.append(Stage(share.log(), position.expand(2, -1, -1, -1), t, torch.ones_like(t)))
        centers.append(truth)
    nothing = torch.zeros(())
    swept = torch.cat((centers[2],) * 4, 1)
    found = SweepEncoding((), nothing, nothing, swept, nothing, tuple(stages), centers[0], tuple(centers))
    return sample, found


def test_the_objective_is_lowest_at_the_truth(slope) -> None:
    sample, found = slope
    unsure = torch.full_like(sample.depth, -3.0)
    best = objective(found, sample.depth, unsure, sample)[1]
    assert all(float(best[name]) < 1e-4 for name in ("depth", "gradient", "stages", "centers", "guess"))

    def worse(term: str, encoding: SweepEncoding = found, decoded: torch.Tensor = sample.depth) -> bool:
        return float(objective(encoding, decoded, unsure, sample)[1][term]) > float(best[term]) + 1e-3

    assert worse("depth", decoded=1.1 * sample.depth)
    assert not worse("gradient", decoded=1.1 * sample.depth)  # the shape is right
    assert worse("guess", found._replace(guess=found.guess + 0.1))
    # gross errors still pull: surfaces that were taken for sky must come back
    gross = [objective(found, sample.depth * factor, unsure, sample)[1]["depth"] for factor in (30, 300)]
    assert gross[1] > gross[0] + 0.3
    for level in range(3):
        centers, stages = list(found.centers), list(found.stages)
        centers[level] = centers[level] + 0.1
        assert worse("centers", found._replace(centers=tuple(centers)))
        stage = stages[level]
        for step in (1, -1):
            stages[level] = stage._replace(logits=stage.logits.roll(step, 1))
            assert worse("planes", found._replace(stages=tuple(stages)))
        stages[level] = stage._replace(t=stage.t + 0.01)
        assert worse("stages", found._replace(stages=tuple(stages)))


def test_sky_only_has_to_be_far(slope) -> None:
    sample, found = slope
    unsure = torch.full_like(sample.depth, -0.3)
    sky = sample._replace(depth=torch.full_like(sample.depth, torch.inf))
    depths = (10.0, 100.0, 200.0, 300.0, 2000.0)  # of a baseline of 0.5, sky begins at 280 baselines
    near, less, far, farther, away = (
        float(objective(found, torch.full_like(sample.depth, d), unsure, sky)[1]["depth"]) for d in depths
    )
    assert near > less > 0.2
    assert far == farther == 0 < away
    assert torch.isfinite(objective(found, sample.depth, unsure, sky)[0])


def test_uncertainty_is_lowest_where_it_says_the_error(slope) -> None:
    sample, found = slope
    scales = torch.linspace(-4, 0, 41)
    off = 1.1 * sample.depth
    terms = [objective(found, off, torch.full_like(off, float(s)), sample)[1]["uncertainty"] for s in scales]
    assert abs(float(scales[torch.stack(terms).argmin()].exp()) - np.log(1.1)) < 0.01


def test_training_continues_from_its_state(scenes: list[Path], tmp_path: Path) -> None:
    """Step, time, weights and their average come back (in half precision), and the average is a backend's weights."""
    config = OmegaConf.create(
        {"training": {"rate": 1e-3, "weight_decay": 0.02, "warmup": 2, "average": 0.5, "token_noise": 0.3}}
    )
    torch.manual_seed(0)
    training, samples = Training(config.training), TrainingSamples(scenes, 0, shapes=SHAPES[:1])
    before = {name: value.clone() for name, value in training.net.state_dict().items()}
    terms = [training.update(samples[n]) for n in range(2)]
    assert all(np.isfinite(list(each.values())).all() for each in terms)
    training.fallen = 1
    training.write(tmp_path, config)
    again = Training(config.training, tmp_path / STATE)
    assert (again.step, again.here, again.fallen) == (2, 0, 1)
    assert again.seconds == pytest.approx(training.seconds, abs=1)
    for name, value in training.net.state_dict().items():
        torch.testing.assert_close(again.net.state_dict()[name], value, rtol=1e-3, atol=1e-6)
        torch.testing.assert_close(again.averaged[name], training.averaged[name], rtol=1e-3, atol=1e-6)
    assert sum(not torch.equal(before[name], value) for name, value in training.net.state_dict().items()) > 100
    assert again.update(samples[2])["loss"] == pytest.approx(training.update(samples[2])["loss"], rel=0.05)
    SweepBackend(path=str(tmp_path / WEIGHTS))
    with safe_open(tmp_path / STATE, "pt") as file:
        assert "rate: 0.001" in file.metadata()["options"]


def test_depth_of_slim_rooms_is_exact_to_a_tenth_of_a_percent() -> None:
    depth = np.array([0.03, 0.5, 2.0, 11.0, 90.0, np.inf])
    found = decode_depth(encode_depth(depth))
    assert np.isinf(found[-1])
    np.testing.assert_allclose(found[:-1], depth[:-1], rtol=1.2e-3)
    paths = [f"{kind}_{n // 12}" for kind in ("walk", "turn", "orbit_far", "near", "far") for n in range(12)]
    chosen = choose(paths)
    assert len(chosen) == len(set(chosen)) == VIEWS
    assert not any(paths[row].startswith("turn") for row in chosen)


def test_a_slim_room_is_read_as_it_was_written(tmp_path: Path) -> None:
    truth = room()
    count = len(truth.images)
    layout_infinigen.write(tmp_path / "room_0001", truth, [f"0_0_{n:04d}_0" for n in range(count)], 1)
    (tmp_path / "room_0001/views.json").write_text(json.dumps([{"path": "walk_0"}] * count))
    (tmp_path / "room_0001/check.json").write_text('{"seed": 1, "kind": "LivingRoom"}')
    (tmp_path / "slim").mkdir()
    write_slim(tmp_path / "room_0001", tmp_path / "slim/room_0001.npz")
    scene = read_scene(tmp_path / "slim/room_0001.npz")
    arrays = read_slim(tmp_path / "slim/room_0001.npz")
    assert scene.images.shape == (count, *truth.images.shape[-2:], 3)
    assert arrays["images"].dtype == np.uint8
    difference = scene.images.permute(0, 3, 1, 2).float() / 255 - truth.images
    assert difference.abs().mean() < 0.03
    shown = truth.depth > 0
    torch.testing.assert_close(scene.depth[shown], truth.depth[shown], rtol=1.2e-3, atol=0)
    assert scene.depth[~shown].isinf().all()
    torch.testing.assert_close(scene.world_to_camera, truth.world_to_camera.float(), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(scene.intrinsics, truth.intrinsics.float(), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("place", [3.25, 19.25])
def test_the_target_of_the_planes_is_in_the_row_that_holds_it(place: float) -> None:
    """A depth in either of two rows is learnt there; one between the rows teaches nothing."""
    position = torch.cat((torch.arange(16) * 0.01 + 0.2, torch.arange(16) * 0.01 + 0.6)).view(1, -1, 1, 1)
    logits = torch.zeros(1, 32, 1, 1, requires_grad=True)
    stage = Stage(logits, position, torch.zeros(1, 1, 1, 1), torch.zeros(1, 1, 1, 1))
    low, share = int(place), place % 1
    t = torch.full((1, 1, 1, 1), float(position[0, low, 0, 0] + 0.01 * share))
    plane_entropy(stage, t, torch.ones_like(t), rows=2).backward()
    assert logits.grad is not None
    expected = torch.full((32,), 1 / 32)
    expected[low] -= 1 - share
    expected[low + 1] -= share
    torch.testing.assert_close(logits.grad.flatten(), expected, rtol=0, atol=1e-4)
    assert float(plane_entropy(stage, torch.full_like(t, 0.5), torch.ones_like(t), rows=2).detach()) == 0


def test_where_training_begins(tmp_path: Path) -> None:
    """With a state in ``out``, else with ``begin``; a fall continues its own, and only if it began from that state."""

    def config(**options: object) -> DictConfig:
        return OmegaConf.create({"out": str(tmp_path / "out"), "begin": None, "cooldown": 0} | options)

    def state(path: Path, step: int, fallen: int = 0) -> Path:
        write_bytes(path, save({"x": torch.zeros(1)}, metadata={"step": str(step), "fallen": str(fallen)}))
        return path

    out, begin = tmp_path / "out", state(tmp_path / "begin.safetensors", 7)
    cooled = out / "cooled"
    assert begun_with(config()) == (out, None)
    assert begun_with(config(begin=str(begin))) == (out, begin)
    with pytest.raises(FileNotFoundError, match=r"begin=.*nowhere does not exist"):
        begun_with(config(begin=str(tmp_path / "nowhere")))
    with pytest.raises(FileNotFoundError, match=r"give a state from which the rate falls, begin=FILE"):
        begun_with(config(cooldown=5))
    assert begun_with(config(begin=str(begin), cooldown=5)) == (cooled, begin)
    base = state(out / STATE, 9)
    assert begun_with(config(begin=str(begin))) == (out, base)
    assert begun_with(config(cooldown=5)) == (cooled, base)
    state(cooled / STATE, 12, 3)
    assert begun_with(config(cooldown=5)) == (cooled, cooled / STATE)
    with pytest.raises(ValueError, match=r"holds a fall of 3 steps, which is over"):
        begun_with(config(cooldown=3))
    state(base, 20)
    with pytest.raises(ValueError, match=r"holds a fall from step 9, not from .*: move it away"):
        begun_with(config(cooldown=5))


@pytest.mark.slow
def test_a_fall_of_the_rate_that_was_stopped_continues(scenes: list[Path], tmp_path: Path) -> None:
    """Three steps, the first of them in a run that is stopped by its time; the state that it began with stays."""
    options = OmegaConf.create({"rate": 1e-3, "weight_decay": 0.02, "average": 0.5})
    Training(options).write(tmp_path, OmegaConf.create())
    kept = (tmp_path / STATE).read_bytes()
    part = "scenes.parts=[{count: 2, first_seed: 5000000, size: [64, 128]}]"
    common = [f"scenes.folder={scenes[0].parent}", part, f"out={tmp_path}", "samples.shapes=[[2,48,96,1]]"]
    command = [sys.executable, "-m", "recipes.sweep", *common, "cooldown=3"]
    for more, begun, made in ((["minutes=0.0001"], 0, 1), ([], 1, 3)):
        done = subprocess.run([*command, *more], cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[-3000:]
        assert f"step {begun}, 2 scenes" in done.stdout
        with safe_open(tmp_path / "cooled" / STATE, "pt") as file:
            assert (file.metadata()["step"], file.metadata()["fallen"]) == (str(made), str(made))
    assert (tmp_path / STATE).read_bytes() == kept
    SweepBackend(path=str(tmp_path / "cooled" / WEIGHTS))
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert "holds a fall of 3 steps, which is over: move it away" in done.stderr
