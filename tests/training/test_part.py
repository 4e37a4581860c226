"""``training.part=coarse``: the coarse module alone, on the losses of geometry, with poses that may be wrong."""

from itertools import islice
from pathlib import Path

import torch
from torch import Tensor

from tests.training_helpers import full_model, small_config
from vg2gt.geometry.cameras import invert_rigid
from vg2gt.geometry.pose_noise import with_pose_noise
from vg2gt.rendering import Renderer
from vg2gt.training.loop import Run, build, train


class NothingIsRendered(Renderer):
    """A renderer that must not be asked."""

    def forward(self, *args: object, **kwargs: object):  # pyright: ignore[reportIncompatibleMethodOverride]
        raise AssertionError("a view was rendered")


def one_step(run: Run) -> tuple[Tensor, dict[str, Tensor]]:
    """Loss and gradients of one step, away from the zero projection, behind which nothing has a gradient."""
    run.datamodule.setup("fit")
    batch = next(iter(run.datamodule.train_dataloader()))
    generator = torch.Generator().manual_seed(0)
    coarse = full_model(run).coarse
    with torch.no_grad():
        for parameter in coarse.parameters():
            parameter += 0.02 * torch.randn(parameter.shape, generator=generator)
    run.module.train()
    run.module.generator.manual_seed(5)
    loss = run.module.training_step(batch, 0)
    loss.backward()
    named = run.module.model.named_parameters()
    return loss.detach(), {name: p.grad for name, p in named if p.requires_grad and p.grad is not None}


def test_it_is_what_is_left_without_the_losses_of_rendered_views(tmp_path: Path, cache: Path) -> None:
    loss, gradients = one_step(build(small_config(tmp_path, cache, "loss.gaussian.weight=0")))
    run = build(small_config(tmp_path, cache, "training.part=coarse"))
    run.module.renderer = NothingIsRendered()
    alone, own = one_step(run)
    torch.testing.assert_close(alone, loss, rtol=1e-6, atol=1e-7)
    assert {name.split(".")[0] for name in own} == {"coarse"}
    for name, gradient in own.items():
        torch.testing.assert_close(gradient, gradients[name], rtol=1e-5, atol=1e-7)


def test_all_is_trained_from_what_it_leaves(tmp_path: Path, cache: Path) -> None:
    run = build(small_config(tmp_path / "all", cache))
    before = run.module.model.trained_state()
    report = train(small_config(tmp_path / "coarse", cache, "training.part=coarse", "trainer.max_steps=2"))
    assert report["trained"]["decoded_abs_rel"] != report["untrained"]["decoded_abs_rel"]
    checkpoint = tmp_path / "coarse" / "checkpoints" / "step-2.ckpt"
    state = torch.load(checkpoint, weights_only=True)["state_dict"]
    changed = {name for name, value in before.items() if not torch.equal(state[f"model.{name}"], value)}
    assert {name.split(".")[0] for name in changed} == {"coarse"}
    (curves,) = (tmp_path / "coarse" / "logs").rglob("metrics.csv")
    curve = curves.read_text().splitlines()[0].split(",")
    assert "train/depth_reg" in curve
    assert "train/color_l1" not in curve
    options = ["trainer.fast_dev_run=true", f"init_from={checkpoint}"]
    assert train(small_config(tmp_path / "next", cache, *options))["trained"]


def test_a_share_of_the_scenes_has_wrong_poses_always_the_same_way(tmp_path: Path, cache: Path) -> None:
    run = build(small_config(tmp_path, cache, "data.train_scenes=12", "data.max_images=8"))
    run.datamodule.setup("fit")
    batches = list(islice(run.datamodule.train_dataloader(), 4))
    turns, shifts, wrong = [], [], 0
    for batch in (batch.context for batch in batches):
        true = batch.hints.cameras
        for share in (0.0, 0.5, 1.0):
            first, again = (with_pose_noise(batch, share).cameras for _ in range(2))
            assert torch.equal(first.world_to_camera, again.world_to_camera)
            assert torch.equal(first.intrinsics, true.intrinsics)
            same = (first.world_to_camera == true.world_to_camera).flatten(1).all(1)
            if share == 0.5:
                wrong += int((~same).sum())
                continue
            assert same.all() if share == 0 else not same.any()
            motion = first.world_to_camera @ invert_rigid(true.world_to_camera)
            if share:
                turns.append(motion[..., 0, 1].abs().mean())
                shifts.append(motion[..., :3, 3].norm(dim=-1).mean() / batch.depth[batch.depth > 0].median())
    assert 0 < wrong < sum(len(batch.scene) for batch in batches)
    assert 0.001 < torch.stack(turns).mean() < 0.006  # TURN times a mean amount of .85, mean of an absolute value
    assert 0.003 < torch.stack(shifts).mean() < 0.02
