"""The recipe of the plane sweep's weights."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch.nn import functional as F

from backends.sweep.backend import SHIPPED, SweepBackend
from backends.sweep.network import PosedViews, Sweep, SweepEncoding
from backends.sweep.volume import from_inverse
from recipes.sweep import average
from recipes.sweep.objective import cell_inverse, objective
from recipes.sweep.samples import Sample, TrainingSamples
from recipes.sweep.scenes import read_infinigen, read_scene, scene_files
from tests.commands import ROOT
from tests.data.sources import layout_infinigen
from tests.data.sources.layouts import room
from vg2gt.geometry.cameras import project, unproject
from vg2gt.types import Cameras


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two rooms, an object, a room from all around; rendered when they are first read."""
    return scene_files(tmp_path_factory.mktemp("scenes"), 4, 5_000_000, (144, 288))


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
    samples = TrainingSamples(scenes, 10, seed=3)
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
    first, again = TrainingSamples(scenes, 10, seed=0), TrainingSamples(scenes, 99, seed=0)
    a, b, other = first[7], again[7], first[8]
    assert all(torch.equal(x, y) for x, y in zip(a[:5], b[:5], strict=True))
    assert a.images.shape != other.images.shape or not torch.equal(a.images, other.images)
    assert (a.depth_range[:, 0] > 0).all()
    assert (a.depth_range[:, 0] < a.depth_range[:, 1]).all()


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
        samples = TrainingSamples([path], 30, seed=0, sizes=[(32, 64, 1)], any_views=any_views)
        forward = [sample.world_to_camera[:, 2, :3] for sample in (samples[n] for n in range(30))]
        return [float((each @ each.T).min()) for each in forward]

    assert min(farthest(1.0)) < -0.7
    assert np.mean(farthest(1.0)) < np.mean(farthest(0.0)) - 0.2


def test_weights_are_averaged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = [tmp_path / f"{n}.safetensors" for n in range(3)]
    for n, file in enumerate(files):
        save_file({"a": torch.full((2,), 3.0 * n).half(), "b": torch.tensor([n])}, file)
    monkeypatch.setattr(sys, "argv", ["average", *map(str, [tmp_path / "out.safetensors", *files])])
    average.main()
    mean = load_file(tmp_path / "out.safetensors")
    assert torch.equal(mean["a"], torch.full((2,), 3.0).half())
    assert torch.equal(mean["b"], torch.tensor([1]))
    save_file({"a": torch.zeros(3), "b": torch.tensor([0])}, files[1])
    with pytest.raises(ValueError, match=r"1\.safetensors does not hold the same network as .*0\.safetensors"):
        average.main()


def test_scenes_of_a_sample_are_encoded_as_if_alone(scenes: list[Path]) -> None:
    sample = next(s for s in TrainingSamples(scenes, 9, seed=1, scenes=2, sizes=[(48, 96, 1)]) if s.planes == 32)
    assert len(sample.images) == 8
    assert (sample.sources[4:] >= 4).all()
    assert (sample.sources[:4] < 4).all()
    assert not torch.equal(sample.depth_range[0], sample.depth_range[4])
    net = SweepBackend().network

    def encode(rows: slice, count: int) -> SweepEncoding:
        images = sample.images[rows]
        views = PosedViews(images, sample.world_to_camera[rows], sample.intrinsics[rows], count)
        sources = sample.sources[rows] - rows.start
        return net.encode(net.features(images), views, sample.depth_range[rows], sources, 32)

    with torch.no_grad():
        both = encode(slice(0, 8), 2)
        alone = [encode(slice(0, 4), 1), encode(slice(4, 8), 1)]
        views = PosedViews(sample.images[4:], sample.world_to_camera[4:], sample.intrinsics[4:])
        features = net.features(views.images)
        as_used = net.encode(features, views, sample.depth_range[4], sample.sources[4:] - 4, 32).taps[-1]
    torch.testing.assert_close(as_used, alone[1].taps[-1], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(both.taps[-1], torch.cat([part.taps[-1] for part in alone]), rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(both.swept, torch.cat([part.swept for part in alone]), rtol=1e-3, atol=1e-3)


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
def slope() -> tuple[Sample, SweepEncoding, torch.Tensor]:
    """A slanted plane, the sweeps that find it exactly, and its depth."""
    inverse = slanted(torch.arange(16.0), torch.arange(16.0)).expand(2, -1, -1)
    depth_range = torch.tensor([1.0, 10.0]).expand(2, 2)
    cameras, sources = (torch.eye(4), torch.eye(3)), torch.tensor([[1], [0]])
    sample = Sample(torch.zeros(2, 3, 16, 16), 1 / inverse, *cameras, depth_range, sources, 16)
    sweeps = []
    for cell, planes in ((4, 16), (2, 12)):
        t = from_inverse(cell_inverse(sample.depth, cell)[0], depth_range)
        position = torch.linspace(0, 1, planes).view(1, -1, 1, 1)
        if cell == 2:  # the second sweep's planes stand around the first one's depth
            position = t + 0.02 * torch.linspace(-1, 1, planes).view(1, -1, 1, 1)
        share = (1 - (position - t).abs() / (position[:, 1:2] - position[:, :1])).clamp_min(1e-6)
        sweeps.append(Sweep(share.log(), position, t, torch.ones_like(t)))
    first, second = sweeps
    swept = torch.cat((-cell_inverse(sample.depth, 2)[0].log(), second.mass), 1)
    nothing = torch.zeros(())
    found = SweepEncoding((), nothing, nothing, swept, first, first.t, second.t, second)
    return sample, found, sample.depth


def test_the_objective_is_lowest_at_the_truth(slope) -> None:
    sample, found, depth = slope
    unsure = torch.full_like(depth, -3.0)
    best = objective(found, depth, unsure, sample)[1]
    assert all(float(best[name]) < 1e-5 for name in ("depth", "gradient", "position", "swept"))

    def worse(term: str, encoding: SweepEncoding = found, decoded: torch.Tensor = depth) -> bool:
        return float(objective(encoding, decoded, unsure, sample)[1][term]) > float(best[term]) + 1e-3

    assert worse("depth", decoded=1.1 * depth)
    assert not worse("gradient", decoded=1.1 * depth)  # the shape is right
    assert worse("gradient", decoded=depth * (1 + 0.1 * torch.rand(depth.shape, generator=torch.Generator())))
    assert worse("swept", found._replace(swept=found.swept + 0.1))
    for name in ("first", "second"):
        sweep = getattr(found, name)
        for step in (1, -1):
            assert worse("planes", found._replace(**{name: sweep._replace(logits=sweep.logits.roll(step, 1))}))
        assert worse("position", found._replace(**{name: sweep._replace(t=sweep.t + 0.01)}))
    for name in ("refined", "center"):
        assert worse("position", found._replace(**{name: getattr(found, name) + 0.01}))


def test_uncertainty_is_lowest_where_it_says_the_error(slope) -> None:
    sample, found, depth = slope
    scales = torch.linspace(-4, 0, 41)
    terms = [objective(found, 1.1 * depth, torch.full_like(depth, float(s)), sample)[1]["uncertainty"] for s in scales]
    assert abs(float(scales[torch.stack(terms).argmin()].exp()) - np.log(1.1)) < 0.01


def test_what_is_beyond_the_planes_only_has_to_be_far(slope) -> None:
    """Sky and what is farther than 1.5 times the farthest plane (10): up to 2.7 times as far will do, nearer not."""
    sample, found, depth = slope
    unsure = torch.full_like(depth, -0.3)
    for truth in (100.0, torch.inf):
        beyond = sample._replace(depth=torch.full_like(depth, truth))
        depths = [torch.full_like(depth, value) for value in (3.0, 12.0, 15.1, 40.0, 90.0)]
        terms = [objective(found, value, unsure, beyond)[1] for value in depths]
        near, less_near, far, farther, away = (float(term["depth"]) for term in terms)
        assert near > less_near > 0.2
        assert far == farther == 0 < away
        assert all(torch.isfinite(value).all() for term in terms for value in term.values())
        sure = objective(found, depths[2], torch.full_like(depth, -4.0), beyond)[1]
        assert float(sure["uncertainty"]) > float(terms[2]["uncertainty"])


def test_rooms_of_infinigen_are_read(tmp_path: Path) -> None:
    layout_infinigen.write(tmp_path / "rooms" / "a", room(), [f"0_0_{n:04d}_0" for n in range(6)], 1)
    (path,) = read_infinigen(tmp_path / "rooms", tmp_path / "cache")
    scene, truth = read_scene(path), room()
    assert scene.images.shape[:1] == scene.intrinsics.shape[:1] == truth.images.shape[:1]
    shown = truth.depth > 0
    torch.testing.assert_close(scene.depth.float()[shown], truth.depth[shown], rtol=1e-3, atol=0)
    assert scene.depth[~shown].isinf().all()


def train(scenes: list[Path], out: Path, steps: int, *options: str) -> str:
    common = [f"scenes.folder={scenes[0].parent}", "scenes.count=2", f"out={out}", f"training.steps={steps}"]
    command = [sys.executable, "-m", "recipes.sweep", *common, *options]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.mark.slow
def test_training_resumes_and_writes_weights(scenes: list[Path], tmp_path: Path) -> None:
    """Two steps at once are two steps one after the other, and the file loads as a backend."""
    saving = ("save_every=1", "training.cooldown=0")
    train(scenes, tmp_path / "whole", 2, *saving)
    train(scenes, tmp_path / "parts", 1, *saving)
    assert "at step 1 of 2" in train(scenes, tmp_path / "parts", 2, *saving)
    nets = [SweepBackend(path=str(tmp_path / part / "sweep.safetensors")).network for part in ("whole", "parts")]
    for a, b in zip(nets[0].parameters(), nets[1].parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-2, atol=1e-3)


@pytest.mark.slow
def test_two_processes_and_given_weights(scenes: list[Path], tmp_path: Path) -> None:
    """Both processes end on the same weights, which are near those that the training began with."""
    train(scenes, tmp_path, 1, "processes=2", f"begin={SHIPPED}")
    with safe_open(tmp_path / "sweep.safetensors", "pt") as made, safe_open(SHIPPED, "pt") as given:
        assert made.metadata()["begun_with"] == SHIPPED.name
        for name in given.keys():  # noqa: SIM118 (no mapping)
            torch.testing.assert_close(made.get_tensor(name), given.get_tensor(name), rtol=0.05, atol=1e-3)
