"""Saves checkpoints while training and keeps the newest."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lightning
from lightning.pytorch.callbacks import Checkpoint

from vg2gt.runs.checkpoints import by_age

LAST_ROW = "last_row"


class NewestCheckpoints(Checkpoint):
    """Saves a checkpoint every few steps and deletes all but the newest, by what the folder holds.

    Nothing is remembered from one process to the next, so a run that is killed at any moment leaves no checkpoint that
    would never be deleted, and those saved on SIGTERM count as well.

    What a step logs, Lightning writes after the step's checkpoint. The checkpoint therefore carries these values, and a
    run that goes on from it writes them: no row of the training curve is lost between the two. Where an evaluation
    follows the step, the checkpoint is saved after it.

    Args:
        dirpath: where checkpoints are written, ``step-<number>.ckpt``.
        every_n_train_steps: a checkpoint every this many steps.
        save_top_k: how many are kept; -1: all.
    """

    def __init__(self, dirpath: str, every_n_train_steps: int = 100, save_top_k: int = 3) -> None:
        if every_n_train_steps < 1 or (save_top_k < 1 and save_top_k != -1):
            raise ValueError(
                f"every_n_train_steps={every_n_train_steps} must be at least 1, save_top_k={save_top_k} at least 1, or "
                "-1 for all"
            )
        self.dirpath = Path(dirpath)
        self.every_n_train_steps = every_n_train_steps
        self.save_top_k = save_top_k
        self._row: dict[str, Any] | None = None

    def on_train_batch_end(self, trainer: lightning.Trainer, *args: Any) -> None:
        """Saves when it is the step's turn, unless an evaluation comes first."""
        if not evaluation_follows(trainer):
            self._save_if_due(trainer)

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Saves when it was the turn of the step before this evaluation."""
        if trainer.state.fn == "fit" and not trainer.sanity_checking:
            self._save_if_due(trainer)

    def _save_if_due(self, trainer: lightning.Trainer) -> None:
        if trainer.global_step % self.every_n_train_steps or getattr(
            trainer, "fast_dev_run", False
        ):  # the attribute is not declared
            return
        trainer.save_checkpoint(self.dirpath / f"step-{trainer.global_step}.ckpt")
        if trainer.is_global_zero and self.save_top_k > 0:
            for path in by_age(self.dirpath)[self.save_top_k :]:
                if path.is_file():
                    path.unlink()

    def on_save_checkpoint(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Adds the values that the step has logged and Lightning has not yet written."""
        every = int(getattr(trainer, "log_every_n_steps", 0))  # likewise
        if trainer.training and every and trainer.global_step % every == 0:
            values = {name: float(v) for name, v in trainer.callback_metrics.items() if not name.startswith("eval/")}
            checkpoint[LAST_ROW] = {"step": trainer.global_step - 1, "epoch": trainer.current_epoch, "values": values}

    def on_load_checkpoint(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Takes these values out again."""
        self._row = checkpoint.get(LAST_ROW)
        # Lightning counts the step after its checkpoint, and not at all where nothing is left to train: the last
        # evaluation would be logged a step early.
        loop = checkpoint.get("loops", {}).get("fit_loop", {}).get("epoch_loop.state_dict")
        if loop is not None and checkpoint["global_step"] == trainer.max_steps:
            loop["_batches_that_stepped"] = checkpoint["global_step"]

    def on_fit_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Writes them to the log of the process that goes on."""
        if self._row is not None:
            for logger in trainer.loggers:
                logger.log_metrics({**self._row["values"], "epoch": self._row["epoch"]}, self._row["step"])
                logger.save()
            self._row = None


def evaluation_follows(trainer: lightning.Trainer) -> bool:
    """Whether the trainer evaluates after this step; with an evaluation every few epochs, unknown and taken as no."""
    every = trainer.val_check_batch
    return (
        trainer.enable_validation
        and trainer.check_val_every_n_epoch is None
        and isinstance(every, int)
        and trainer.global_step % every == 0
    )
