"""The whole forward pass on a procedural room with the simulated backbone."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.errors import InstantiationException

from backends.oracle import OracleBackend
from tests.training_helpers import full_model, small_config
from vg2gt.baselines import PointCloud
from vg2gt.evaluation.protocols import ground_truth_target_cameras, training_cameras
from vg2gt.model import VG2GT, SceneScale, with_scale_of
from vg2gt.training.loop import Run, build
from vg2gt.types import Batch
from vg2gt.visibility import ViewCheck


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    cache = tmp_path_factory.mktemp("rooms")
    views = ["data.image_size=[56,112]", "data.max_views=8", "data.max_images=8"]
    return build(small_config(tmp_path_factory.mktemp("run"), cache, *views))


@pytest.fixture(scope="module")
def batch(run: Run) -> Batch:
    run.datamodule.setup("validate")
    return next(iter(run.datamodule.val_dataloader())).single(0)


@pytest.fixture
def model(run: Run) -> VG2GT:
    return full_model(run).eval()


def test_at_initialisation_the_second_decoding_is_the_first(model: VG2GT, batch: Batch) -> None:
    assert model.coarse is not None
    prediction = model(batch.context.images, batch.context.hints)
    assert torch.equal(prediction.geometry.depth, prediction.initial.depth)
    assert torch.equal(prediction.geometry.depth_conf, prediction.initial.depth_conf)


def test_layers_that_a_backend_adds_late_are_frozen(run: Run) -> None:
    """Its parent's constructor has frozen what was there before."""

    class Later(OracleBackend):
        def __init__(self) -> None:
            super().__init__()
            self.head = torch.nn.Sequential(torch.nn.Linear(2, 2), torch.nn.Dropout())

    backend = Later()
    assert any(parameter.requires_grad for parameter in backend.parameters())
    model = PointCloud(backend, SceneScale("normalize"))
    assert not model.trained_parameters()
    assert not any(module.training for module in model.train().backend.modules())


def test_world_is_the_frame_of_view_zero_in_scene_units(model: VG2GT, batch: Batch) -> None:
    prediction = model(batch.context.images, batch.context.hints)
    assert torch.equal(prediction.geometry.cameras.world_to_camera[:, 0], torch.eye(4)[None])
    depth = prediction.initial.depth
    assert float(depth[depth > 0].median()) == pytest.approx(1.0, abs=1e-5)


def test_untrained_head_renders_the_room_without_holes(run: Run, model: VG2GT, batch: Batch) -> None:
    prediction = model(batch.context.images, batch.context.hints)
    cameras = prediction.geometry.cameras
    rendered = run.module.renderer(prediction.gaussians, cameras)
    seen = prediction.geometry.depth > 0
    assert float((rendered.depth[seen] == 0).float().mean()) < 0.005
    error = (rendered.color.detach() - batch.context.images).abs().mean()
    assert float(error) < 0.1


def test_rays_that_meet_nothing_show_the_scenes_mean_colour(run: Run, model: VG2GT, batch: Batch) -> None:
    prediction = model(batch.context.images, batch.context.hints)
    background = prediction.gaussians.background
    torch.testing.assert_close(background, batch.context.images.mean((1, 3, 4)))
    cameras = prediction.geometry.cameras
    away = replace(cameras, world_to_camera=cameras.world_to_camera.clone())
    away.world_to_camera[..., 2, 3] -= 1000.0
    seen = run.module.renderer(prediction.gaussians, away).color[0, 0]
    torch.testing.assert_close(seen, background[0, :, None, None].expand_as(seen))
    unseen = batch.context.hints.depth
    unseen = unseen.clone()
    unseen[:, :, :20] = 0  # a sky
    hints = replace(batch.context.hints, depth=unseen)
    background = model(batch.context.images, hints).gaussians.background
    sky = batch.context.images[..., :20, :].mean((1, 3, 4))
    assert (
        float((background - sky).abs().max()) < 0.02 < float((sky - batch.context.images.mean((1, 3, 4))).abs().max())
    )
    model.background = "black"
    try:
        assert model(batch.context.images, batch.context.hints).gaussians.background is None
    finally:
        model.background = "mean"
    other: Any = "white"
    with pytest.raises(ValueError, match=r"model\.background is 'white'; choose one of mean, black"):
        VG2GT(model.backend, SceneScale(), None, lambda **_: model.fine, lambda **_: model.gaussians, background=other)


def test_target_cameras_of_both_protocols_agree(model: VG2GT, batch: Batch) -> None:
    prediction = model(batch.context.images, batch.context.hints)
    joint = training_cameras(model, batch, prediction)
    truth = ground_truth_target_cameras(batch, prediction)
    held_out = joint.world_to_camera[:, batch.num_context :]
    assert joint.world_to_camera.shape[1] == batch.images.shape[1]
    assert float((held_out[..., :3, :3] - truth.world_to_camera[..., :3, :3]).abs().max()) < 0.02
    assert float((held_out[..., :3, 3] - truth.world_to_camera[..., :3, 3]).abs().max()) < 0.05


@pytest.mark.parametrize("source", ["metric", "focal", "normalize", "groundtruth"])
def test_scale_sources(run: Run, batch: Batch, source: str) -> None:
    geometry = run.module.model.backend.decode(
        run.module.model.backend.encode(batch.context.images, batch.context.hints)
    )
    unit = SceneScale(source, median_depth=2.0)(geometry, batch.context.hints)  # type: ignore[arg-type]
    valid = geometry.depth[geometry.depth > 0]
    expected = {
        "metric": 1.0,
        "focal": float(geometry.cameras.intrinsics[0, 0, 0, 0]) / 300,
        "normalize": 2.0 / float(valid.median()),
        "groundtruth": 1.0,
    }
    assert float(unit) == pytest.approx(expected[source], rel=0.02)


@pytest.mark.parametrize("drift", [0.9, 1.08, 3.0])
def test_a_common_factor_is_taken_out_of_the_enhanced_depth(run: Run, batch: Batch, drift: float) -> None:
    """The scale of depth against the cameras is the backbone's, whatever the enhancement does to it."""
    initial = run.module.model(batch.context.images, batch.context.hints).initial
    shape = (1 + 0.05 * torch.randn(initial.depth.shape, generator=torch.Generator().manual_seed(0))).requires_grad_()
    kept, drifted = (with_scale_of(initial, initial.depth * shape * factor) for factor in (1.0, drift))
    torch.testing.assert_close(drifted, kept)
    weight = initial.depth_conf * (initial.depth > 0)
    mean = (weight * (kept / initial.depth.clamp(min=1e-9)).clamp(min=1e-9).log()).sum() / weight.sum()
    assert abs(mean.item()) < 1e-5
    # No loss of it says anything of the common factor: its gradient along the depth's logarithm sums to zero.
    (gradient,) = torch.autograd.grad((kept.square() * torch.linspace(0, 1, kept.shape[-1])).sum(), shape)
    total = (gradient * shape).sum()
    assert abs(total.item()) < 1e-4 * (gradient * shape).abs().sum().item()


def test_without_the_switch_the_scale_may_drift(run: Run, batch: Batch) -> None:
    model = full_model(run).eval()
    model.keep_scale = False
    bias = model.get_parameter("coarse.zero.3.bias")
    torch.nn.init.constant_(bias, 0.3)
    drifted = model(batch.context.images, batch.context.hints)
    model.keep_scale = True
    kept = model(batch.context.images, batch.context.hints)
    change = (drifted.geometry.depth / kept.geometry.depth.clamp(min=1e-9))[kept.geometry.depth > 0]
    torch.testing.assert_close(change, change[0].expand_as(change))
    assert abs(float(change[0].detach()) - 1) > 1e-4
    torch.nn.init.zeros_(bias)


def test_confirmed_depth_is_kept_only_with_the_check_of_views(run: Run, batch: Batch, tmp_path: Path) -> None:
    model = full_model(run).eval()
    bias = model.get_parameter("coarse.zero.3.bias")
    torch.nn.init.constant_(bias, 0.3)
    model.keep_scale = False
    changed = model(batch.context.images, batch.context.hints)
    model.visibility, model.keep_agreed = (
        ViewCheck(tolerance=0.5, margin=0.9, moved_margin=0.9),
        True,
    )  # almost all is confirmed
    kept = model(batch.context.images, batch.context.hints)
    model.visibility, model.keep_agreed, model.keep_scale = None, False, True
    torch.nn.init.zeros_(bias)
    error = [(found.geometry.depth - found.initial.depth).abs().mean() for found in (changed, kept)]
    assert 0 < error[1] < 0.3 * error[0]
    with pytest.raises(InstantiationException, match=r"model\.keep_agreed=true requires model\.visibility"):
        build(small_config(tmp_path, tmp_path, "+model.keep_agreed=true"))


@pytest.mark.parametrize(("most", "held_out", "context"), [(1, 0, 1), (2, 1, 1), (3, 2, 1), (5, 3, 2), (None, 3, 8)])
def test_every_step_renders_a_context_view(run, batch, monkeypatch, most, held_out, context):
    assert (batch.num_context, batch.images.shape[1]) == (8, 11)
    monkeypatch.setattr(run.module, "render_views", most)
    drawn = [run.module._draw_views(batch).tolist() for _ in range(20)]
    for views in drawn:
        assert len(set(views)) == len(views) == held_out + context
        assert sum(view >= 8 for view in views) == held_out
    assert len({tuple(sorted(views)) for views in drawn}) > 1 or most is None
