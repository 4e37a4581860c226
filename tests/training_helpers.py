"""A training run small enough for a test: two rooms of 28x56, four views."""

from pathlib import Path
from typing import Any

import lightning
import torch
from omegaconf import DictConfig, OmegaConf, open_dict

from vg2gt.config import compose, compose_groups, config_dir, plugin_targets, variants
from vg2gt.model import VG2GT, Reconstructor
from vg2gt.runs.checkpoints import MADE_OF
from vg2gt.runs.load import made_of
from vg2gt.training.loop import Run

SMALL = [
    *("data.image_size=[28,56]", "data.train_scenes=2", "data.eval_scenes=1", "training.render_views=1"),
    *("data.min_views=4", "data.max_views=4", "data.max_images=4", "trainer.accelerator=cpu", "trainer.max_steps=4"),
    *("trainer.enable_progress_bar=false", "callbacks.progress_bar=null", "++trainer.log_every_n_steps=1"),
    "callbacks.checkpoint.every_n_train_steps=2",
]
# The layers of the paper's model with few channels.
NARROW = [
    *("model.coarse.hidden=[64,32]", "model.coarse.fuse_channels=32", "++model.fine.dense_head.features=16"),
    *("model.coarse.ptv3.enc_channels=[32,32,32,32,32]", "model.coarse.ptv3.dec_channels=[32,32,32,32]"),
    *("model.coarse.ptv3.enc_heads=[2,2,2,2,2]", "model.coarse.ptv3.dec_heads=[2,2,2,2]"),
]


def group_options(group: str) -> list[str]:
    """The options that ``group=`` accepts, sorted."""
    files = (path.stem for path in Path(config_dir(), group).glob("*.yaml"))
    return sorted({*plugin_targets().get(group, {}), *variants().get(group, {}), *files})


def small_config(folder: Path, cache: Path, *overrides: str) -> DictConfig:
    """Composes the default configuration with :data:`SMALL` and ``overrides``."""
    return compose("train", f"output_dir={folder}", f"data.cache_dir={cache}", *SMALL, *overrides)


def write_run(folder: Path, model: Reconstructor, mark: float = 0.0) -> Path:
    """A training run's folder of an oracle's tiny model, its head known by a mark in one weight."""
    (folder / "checkpoints").mkdir(parents=True)
    config = compose_groups("backend=oracle", "model=tiny", "renderer=solid")
    OmegaConf.save(config, folder / "config.yaml")
    state = {f"model.{key}": value for key, value in model.state_dict().items() if not key.startswith("backend.")}
    state["model.gaussians.out.bias"] = state["model.gaussians.out.bias"] + mark
    checkpoint = {"state_dict": state, "backend": dict(model.backend.identity()), "global_step": 7}
    torch.save(checkpoint | {MADE_OF: made_of(config)}, folder / "checkpoints" / "step-7.ckpt")
    return folder


class CrashAfter(lightning.Callback):
    """Raises after a step, as a crash would end the process."""

    def __init__(self, step: int) -> None:
        self.step = step

    def on_train_batch_end(self, trainer: lightning.Trainer, *args: Any) -> None:
        if trainer.global_step == self.step:
            raise InterruptedError("simulated crash")


def with_crash(config: DictConfig, step: int) -> DictConfig:
    """Adds a crash after ``step`` to a configuration."""
    with open_dict(config):
        config.callbacks.crash = {"_target_": f"{__name__}.CrashAfter", "step": step}
    return config


def full_model(run: Run) -> VG2GT:
    """The run's model, known to be the paper's."""
    assert isinstance(run.module.model, VG2GT)
    return run.module.model
