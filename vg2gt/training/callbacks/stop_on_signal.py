"""Saves and ends the run when the machine asks it to stop."""

from __future__ import annotations

import logging
import signal
from pathlib import Path
from types import FrameType
from typing import Any

import lightning
from lightning.pytorch.trainer.states import TrainerFn

from vg2gt.training.callbacks.newest_checkpoints import evaluation_follows

log = logging.getLogger(__name__)

TERMINATED = 128 + signal.SIGTERM
SIGNALS = (signal.SIGTERM, signal.SIGUSR1) if hasattr(signal, "SIGUSR1") else (signal.SIGTERM,)


class StopOnSignal(lightning.Callback):
    """On SIGTERM: finishes the training step, writes a checkpoint and ends normally (``ckpt=last`` goes on).

    SIGUSR1, with which SLURM announces the end of a job's time, is answered alike; Lightning's own answer would save in
    the middle of a step.

    In the evaluations before and after the training there is nothing to save: the process ends with status 143.

    Args:
        folder: where checkpoints are written, the same as the checkpoint callback's.
    """

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)
        self.received = False
        self._previous: dict[signal.Signals, Any] = {}

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Takes over the signals for the time of the training."""
        self._take_over()

    def on_validation_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Takes over the signals for the time of an evaluation."""
        self._take_over()

    def _take_over(self) -> None:
        for number in SIGNALS:
            if signal.getsignal(number) != self._note:
                self._previous[number] = signal.signal(number, self._note)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.received = True

    def on_train_batch_end(self, trainer: lightning.Trainer, *args: Any) -> None:
        """Saves and stops at the end of the step in which a signal came (on any rank)."""
        # Lightning's own handler is in place until the training starts, and only takes a note.
        asked = self.received or bool(getattr(trainer, "received_sigterm", False))
        if trainer.strategy.reduce_boolean_decision(asked, all=False):
            path = self.folder / f"step-{trainer.global_step}.ckpt"
            trainer.save_checkpoint(path)
            if not evaluation_follows(trainer):
                trainer.limit_val_batches = 0  # a trainer that is told to stop evaluates once more
            trainer.should_stop = True
            log.warning("stopping as asked by a signal: saved %s, go on with ckpt=last", path)

    def on_validation_batch_end(self, trainer: lightning.Trainer, *args: Any) -> None:
        """Ends the process if a signal came in an evaluation outside the training."""
        if self.received and trainer.state.fn == TrainerFn.VALIDATING:
            log.warning("stopping as asked by a signal during an evaluation; a trained run goes on with ckpt=last")
            raise SystemExit(TERMINATED)

    def teardown(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, stage: str) -> None:
        """Gives back the signals that Lightning has not yet given back itself, after an error as well."""
        for number, handler in self._previous.items():
            if signal.getsignal(number) == self._note:
                signal.signal(number, handler)
        self._previous = {}
