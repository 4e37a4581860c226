"""``backend.freeze=false``: the backbone is trained too, at a rate of its own, and checkpoints hold it."""

from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate

from tests.training_helpers import small_config
from vg2gt.runs.checkpoints import newest, read_checkpoint
from vg2gt.runs.load import load_model
from vg2gt.training.loop import build, train

CAMERAS = {"da3_tiny": "network.cam_dec.", "vggt_tiny": "network.camera_head."}
UNFROZEN = "backend.freeze=false"


@pytest.mark.parametrize("backend", CAMERAS)
def test_gradients_reach_all_but_the_cameras(tmp_path: Path, cache: Path, backend: str) -> None:
    config = small_config(tmp_path, cache, f"backend={backend}", UNFROZEN)
    model = instantiate(config.model, backend=instantiate(config.backend))
    prediction = model(torch.rand(1, 2, 3, 28, 56))
    gaussians, geometry = prediction.gaussians, prediction.geometry
    loss = gaussians.means.sum() + gaussians.sh.sum() + geometry.depth.log().mean() + geometry.depth_conf.mean()
    loss.backward()
    reached = {name for name, p in model.backend.named_parameters() if p.grad is not None and bool(p.grad.any())}
    every = {name for name, _ in model.backend.named_parameters()}
    assert reached == {name for name in every if not name.startswith(CAMERAS[backend])}
    assert {p for p in model.backend.parameters() if p.requires_grad} <= set(model.trained_parameters())


def test_a_checkpoint_holds_a_trained_backbone(tmp_path: Path, cache: Path) -> None:
    given = ["backend=da3_tiny", "trainer.max_steps=2", "training.warmup_steps=0"]
    trained = train(small_config(tmp_path / "first", cache, *given, UNFROZEN, "training.backend_lr_factor=0.5"))
    path = newest(tmp_path / "first" / "checkpoints")
    stored = read_checkpoint(path)["state_dict"]
    weight = "backend.network.backbone.pretrained.blocks.0.attn.qkv.weight"
    fresh = build(small_config(tmp_path / "fresh", cache, *given)).module.model
    rate = small_config(tmp_path, cache).optimizer.lr
    moved = float((stored["model." + weight] - fresh.state_dict()[weight]).abs().max())
    assert 0 < moved < 1.1 * 2 * 0.5 * rate  # two steps of Adam
    loaded = load_model(tmp_path / "first").model
    assert all(torch.equal(value, stored["model." + name]) for name, value in loaded.trained_state().items())
    assert weight in loaded.trained_state()
    again = train(small_config(tmp_path / "again", cache, *given, UNFROZEN, f"init_from={path}"))
    assert again["untrained"] == trained["trained"]
    # other parts may be frozen
    train(small_config(tmp_path / "plain", cache, *given))
    train(small_config(tmp_path / "coarse", cache, *given, "training.part=coarse", f"init_from={tmp_path / 'plain'}"))
    # a frozen backbone would be neither the trained one nor in the new checkpoints
    with pytest.raises(ValueError, match="holds a trained backbone, but this one is frozen"):
        train(small_config(tmp_path / "frozen", cache, *given, f"init_from={path}"))
    with pytest.raises(ValueError, match=r"holds a trained backbone: use the same backend= with backend\.freeze=false"):
        load_model(tmp_path / "first", overrides=["backend.freeze=true"])
