"""Training steps on chosen batches, with a record of what every step did to weights and moments."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import lightning
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from tests.training_helpers import small_config
from vg2gt.training.loop import Run, build
from vg2gt.types import Batch

TINY = [
    "data.steps_per_epoch=100",
    "data.image_size=[28,56]",
    "data.min_views=2",
    "data.max_views=2",
    "data.max_images=2",
    "data.target_views=1",
    "data.eval_context=[0,4]",
    "data.eval_target=[2]",
    "+training.max_skipped=1000",
    "training.render_views=2",
    "callbacks.checkpoint=null",
    "callbacks.stop_on_signal=null",
    "logger.csv=null",
]


class Audit(lightning.Callback):
    """Compares weights and optimiser moments after every step with those before it."""

    def __init__(self) -> None:
        self.changed: list[bool] = []
        self.finite: list[bool] = []
        self.skipped: list[bool] = []
        self.rates: list[float] = []
        self._before = torch.empty(0)
        self._total = 0

    def on_train_batch_start(self, trainer: lightning.Trainer, pl_module: Any, *args: Any) -> None:
        self._before = state(trainer, pl_module)
        self._total = pl_module.skipped.total
        self.rates.append(trainer.optimizers[0].param_groups[0]["lr"])

    def on_train_batch_end(self, trainer: lightning.Trainer, pl_module: Any, *args: Any) -> None:
        now = state(trainer, pl_module)
        self.changed.append(not torch.equal(now, self._before))
        self.finite.append(bool(torch.isfinite(now).all()))
        self.skipped.append(pl_module.skipped.total > self._total)

    def assert_sound(self) -> None:
        """Every step either was dropped and changed nothing, or left everything finite."""
        assert all(self.finite)
        assert self.changed == [not skipped for skipped in self.skipped]


def state(trainer: lightning.Trainer, module: torch.nn.Module) -> Tensor:
    """Trained weights and the optimiser's tensors, copied into one row."""
    moments = [each[name] for each in trainer.optimizers[0].state.values() for name in sorted(each)]
    weights = [parameter.detach() for parameter in module.parameters() if parameter.requires_grad]
    return torch.cat([tensor.flatten() for tensor in (*weights, *moments) if isinstance(tensor, Tensor)])


def tiny_run(folder: Path, cache: Path, *overrides: str) -> Run:
    """A run of the default configuration with 28 x 56 images, two context views and one held-out view."""
    return build(small_config(folder, cache, *TINY, *overrides))


def first_batches(run: Run, count: int) -> list[Batch]:
    """The first training batches of a run."""
    run.datamodule.setup("fit")
    batches = iter(run.datamodule.train_dataloader())
    return [next(batches) for _ in range(count)]


def named(batch: Batch, name: str) -> Batch:
    """The same batch under another scene name."""
    return replace(batch, scene=(name,) * len(batch.scene))


def fit(run: Run, batches: Sequence[Batch]) -> Audit:
    """Trains one step on every batch."""
    audit = Audit()
    run.trainer.callbacks.append(audit)  # pyright: ignore[reportAttributeAccessIssue]
    run.trainer.fit_loop.epoch_loop.max_steps = len(batches)  # pyright: ignore[reportAttributeAccessIssue]
    loader = DataLoader(list(batches), batch_size=None)  # pyright: ignore[reportArgumentType]
    run.trainer.fit(run.module, train_dataloaders=loader)
    return audit


class Poison(lightning.Callback):
    """Spoils the images of some steps, on one rank or all."""

    def __init__(self, steps: Sequence[int], rank: int | None = None) -> None:
        self.steps = list(steps)
        self.rank = rank

    def on_train_batch_start(self, trainer: lightning.Trainer, pl_module: Any, batch: Batch, batch_idx: int) -> None:
        if trainer.global_step in self.steps and self.rank in (None, trainer.global_rank):
            batch.images[0, 0] = float("nan")
