"""The models to compare with: counts, order of views, gradients, whole runs."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate
from safetensors.torch import save_file

from tests.training_helpers import SMALL, small_config
from vg2gt.baselines import VoxelMerged
from vg2gt.baselines.pixel_aligned import merge_by_voxel
from vg2gt.baselines.pixels import usable_pixels
from vg2gt.geometry.rotations import quat_to_matrix
from vg2gt.geometry.spherical_harmonics import sh_to_rgb
from vg2gt.model import Reconstructor
from vg2gt.rendering import render
from vg2gt.studies.study import run_once
from vg2gt.training.loop import build, train
from vg2gt.types import Batch, Gaussians, Hints, Prediction

TRAINED = ["pixel_aligned", "voxel_merged"]
ALL = [*TRAINED, "pointcloud"]
VIEWS = 4


@pytest.fixture(scope="module")
def batch(cache: Path, tmp_path_factory: pytest.TempPathFactory) -> Batch:
    data = instantiate(small_config(tmp_path_factory.mktemp("run"), cache, "data.eval_context=[0,4,8,12]").data)
    data.setup("validate")
    return next(iter(data.val_dataloader()))


@pytest.fixture(scope="module")
def make(cache: Path, tmp_path_factory: pytest.TempPathFactory):
    """Models by name, with random numbers in the last layer where one is trained."""

    def make(name: str, *overrides: str, seed: int | None = None) -> Reconstructor:
        config = small_config(tmp_path_factory.mktemp("run"), cache, f"model={name}", *overrides)
        torch.manual_seed(0)
        model = instantiate(config.model, backend=instantiate(config.backend))
        if seed is not None:
            torch.manual_seed(seed)
            torch.nn.init.normal_(model.gaussians.out.weight, std=0.3)
        return model

    return make


def predict(model: Reconstructor, batch: Batch) -> Prediction:
    return model(batch.context.images, batch.context.hints)


@pytest.mark.parametrize("name", TRAINED)
def test_fast_dev_run(tmp_path: Path, cache: Path, name: str) -> None:
    report = train(small_config(tmp_path, cache, "trainer.fast_dev_run=true", f"model={name}"))
    assert {"psnr", "abs_rel", "decoded_abs_rel"} <= set(report["trained"])
    assert all(value == value for value in report["trained"].values())
    assert report["trained"]["decoded_abs_rel"] == report["trained"]["decoded_abs_rel_before"]


def test_point_cloud_is_evaluated_and_not_trained(tmp_path: Path, cache: Path) -> None:
    config = small_config(tmp_path, cache, "model=pointcloud")
    with pytest.raises(ValueError, match="PointCloud has no trained part"):
        train(config)
    assert not list(tmp_path.glob("config.yaml"))
    run = build(config)
    (metrics,) = run.trainer.validate(run.module, datamodule=run.datamodule, verbose=False)
    assert metrics["eval/psnr"] > 15
    assert 0 < metrics["eval/abs_rel"] < 0.1


@pytest.mark.parametrize("name", ALL)
def test_one_gaussian_a_valid_pixel(make, batch: Batch, name: str) -> None:
    """All pixels of the views, less those without depth; merging by voxels only ever makes fewer."""
    depth = batch.context.depth.clone()
    depth[:, 1, :10] = 0
    hints = replace(batch.context.hints, depth=depth)
    full = make(name)(batch.context.images, batch.context.hints)
    holey = make(name)(batch.context.images, hints)
    height, width = batch.images.shape[-2:]
    pixels = int((full.geometry.depth > 0).sum())
    if name == "voxel_merged":
        assert 0 < len(holey.gaussians) < len(full.gaussians) < pixels
    else:
        assert (pixels, len(full.gaussians)) == (VIEWS * height * width, pixels)
        assert len(holey.gaussians) == pixels - 10 * width


def reordered(batch: Batch, order: list[int]) -> tuple[torch.Tensor, Hints]:
    context = batch.context
    hints = context.hints
    views = torch.tensor(order)
    changed = Hints(hints.depth[:, views], hints.cameras.select(views), hints.scene_key, hints.frame_ids[:, views])
    return context.images[:, views], changed


def table(gaussians: Gaussians) -> torch.Tensor:
    return torch.cat(
        (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities[:, None], gaussians.sh.flatten(1)), 1
    )


@pytest.mark.parametrize("name", ["pixel_aligned", "pointcloud"])
def test_another_first_view_turns_the_scene_and_nothing_else(make, batch: Batch, name: str) -> None:
    """All is predicted in camera axes, so the Gaussians move with the cameras; like predictions for all pixels."""
    model = make(name, "backend.depth_noise=0", seed=None if name == "pointcloud" else 3)
    if name == "pixel_aligned":  # tokens carry the place in the world, by which predictions would differ
        torch.nn.init.zeros_(model.gaussians.hidden.weight)
    images, hints = reordered(batch, [1, 0, 2, 3])
    with torch.no_grad():
        one, two = predict(model, batch), model(images, hints)
    turn = one.geometry.cameras.world_to_camera[0, 1]
    means = one.gaussians.means @ turn[:3, :3].T + turn[:3, 3]
    moved = torch.cat([part for index in (1, 0, 2, 3) for part in means.chunk(VIEWS)[index : index + 1]])
    assert float((two.gaussians.means - moved).abs().max()) < 1e-4
    shown = [render(p.gaussians, p.geometry.cameras).color.mean(0) for p in (one, two)]
    assert float((shown[0][[1, 0, 2, 3]] - shown[1]).abs().mean()) < 1e-3


def test_view_dependent_colours_turn_with_the_camera(make, batch: Batch) -> None:
    """Like features show like colours along like rays of every camera: harmonics too are predicted in camera axes."""
    model = make("pixel_aligned", "model.gaussians.sh_degree=2", seed=6)
    pixels = usable_pixels(predict(model, batch).geometry, torch.full_like(batch.context.images, 0.5))
    features = torch.randn(1, model.gaussians.hidden.in_features).expand(len(pixels.rows), -1)
    with torch.no_grad():
        gaussians, _ = model.gaussians(features, pixels)
    ray = torch.nn.functional.normalize(torch.tensor([0.2, -0.3, 0.9]), dim=0)  # in camera axes
    seen = sh_to_rgb(gaussians.sh, pixels.rotation @ ray)
    assert float((seen.amax(0) - seen.amin(0)).max()) < 1e-5
    elsewhere = sh_to_rgb(gaussians.sh, ray.expand(len(seen), -1))  # one direction of the world is many of the cameras
    assert float((elsewhere.amax(0) - elsewhere.amin(0)).max()) > 5e-3


@pytest.mark.parametrize("name", TRAINED)
def test_gradient_reaches_every_parameter(make, batch: Batch, name: str) -> None:
    model = make(name, "model.gaussians.sh_degree=1", seed=4)
    prediction = predict(model, batch)
    shown = render(prediction.gaussians, prediction.geometry.cameras.select(slice(0, 2)))
    ((shown.color - batch.images[:, :2]).square().mean() + 0.1 * shown.depth.mean()).backward()
    trained = {name: p for name, p in model.named_parameters() if p.requires_grad}
    assert len(trained) == len(model.trained_parameters())
    silent = [name for name, p in trained.items() if p.grad is None or not bool(p.grad.any())]
    assert not silent
    if isinstance(model, VoxelMerged):  # the confidence as well
        assert bool(model.gaussians.out.weight.grad[-1].any())  # type: ignore[index]
    assert all(p.grad is None for p in model.backend.parameters())


def test_merging_is_a_weighted_mean() -> None:
    """Against a loop over voxels."""
    torch.manual_seed(5)
    count = 60
    gaussians = Gaussians(
        torch.rand(count, 3) - 0.5,
        torch.nn.functional.normalize(torch.randn(count, 4), dim=-1),
        torch.rand(count, 3),
        torch.rand(count),
        torch.randn(count, 4, 3),
        torch.arange(count) // 30,
    )
    weights, size = torch.rand(count) + 0.1, torch.tensor([0.5, 0.25])
    merged = merge_by_voxel(gaussians, weights, size)
    voxels: dict[tuple[int, ...], list[int]] = {}
    for row in range(count):
        scene = int(gaussians.batch[row])
        cell = (gaussians.means[row].double() / size[scene].double()).floor().long().tolist()
        voxels.setdefault((scene, *cell), []).append(row)
    assert len(merged) == len(voxels)
    assert max(map(len, voxels.values())) > 2
    for index, (key, rows) in enumerate(sorted(voxels.items())):
        w = weights[rows] / weights[rows].sum()
        assert int(merged.batch[index]) == key[0]
        for name in ("means", "scales", "opacities", "sh"):
            values = getattr(gaussians, name)[rows]
            expected = (w.reshape(-1, *(1,) * (values.dim() - 1)) * values).sum(0)
            torch.testing.assert_close(getattr(merged, name)[index], expected, atol=1e-6, rtol=1e-5)
    turned = replace(gaussians, quats=-gaussians.quats)
    torch.testing.assert_close(merge_by_voxel(turned, weights, size).quats, merged.quats)
    assert torch.allclose(merged.quats.norm(dim=-1), torch.ones(len(merged)))


def test_rotations_near_a_half_turn_do_not_cancel() -> None:
    """Two cameras a little before and after a half turn from view 0: w changes its sign between them."""
    axis = torch.nn.functional.normalize(torch.tensor([0.35, 0.9, 0.25]), dim=0)
    half = torch.deg2rad(torch.tensor([[175.0], [186.0], [180.5]])) / 2
    before, after, between = torch.cat((half.cos(), half.sin() * axis), 1)
    pair = torch.stack((before, -after))
    gaussians = Gaussians(
        torch.full((2, 3), 0.1), pair, torch.ones(2, 3), torch.ones(2), torch.zeros(2, 1, 3), torch.zeros(2).long()
    )
    merged = merge_by_voxel(gaussians, torch.ones(2), torch.ones(1))
    torch.testing.assert_close(quat_to_matrix(merged.quats[0]), quat_to_matrix(between), atol=1e-4, rtol=1e-4)


def test_point_cloud_as_3dgs_starts(make, batch: Batch) -> None:
    """Spacing to the three nearest points, against all distances."""
    model = make("pointcloud", "+model.spacing=neighbors", "+model.width=1", "+model.opacity=0.1")
    gaussians = predict(model, batch).gaussians
    some = torch.arange(0, len(gaussians), 997)
    distances = torch.cdist(gaussians.means[some].double(), gaussians.means.double()).sort(1).values[:, 1:4]
    expected = distances.square().mean(1).sqrt().float()
    torch.testing.assert_close(gaussians.scales[some, 0], expected, atol=1e-5, rtol=1e-4)
    assert float(gaussians.opacities.max()) == pytest.approx(0.1)


def test_gaussians_of_da3(make, batch: Batch, tmp_path: Path, cache: Path) -> None:
    """On random weights, from the frames to the scores: nothing is trained, a Gaussian is made of every pixel."""
    given = ["model=da3_gs", "backend=da3_tiny", "data.eval_context=[0,4,8,12]", f"data.cache_dir={cache}"]
    scores = run_once([*SMALL, *given, "trainer.max_steps=0"], tmp_path)
    assert scores["gaussians"] == batch.context.depth.numel()
    assert all(math.isfinite(scores[name]) for name in ("psnr", "abs_rel", "cv"))
    with pytest.raises(Exception, match="requires backend=da3_giant, got oracle"):
        make("da3_gs")


def test_a_file_without_a_gaussian_head_is_refused(make, tmp_path: Path) -> None:
    backend = make("pointcloud", "backend=da3_tiny").backend
    file = tmp_path / "model.safetensors"
    save_file({f"model.{name}": value for name, value in backend.network.state_dict().items()}, file)
    given = ["backend=da3_tiny", "backend.pretrained=true", f"backend.path={file}"]
    make("pointcloud", *given)
    with pytest.raises(Exception, match=r"da3_tiny has no Gaussian head, da3_giant has one: .*Missing key"):
        make("da3_gs", *given)


def test_two_scenes_equal_two_runs(make, batch: Batch) -> None:
    context = batch.context
    double = context.map(lambda t: torch.cat((t, t)))
    double = replace(double, scene=context.scene * 2)
    for name in ALL:
        model = make(name)
        with torch.no_grad():
            one = predict(model, batch).gaussians
            two = model(double.images, double.hints).gaussians
        assert len(two) == 2 * len(one)
        torch.testing.assert_close(table(two.scene(1)), table(one), atol=1e-5, rtol=1e-5)
