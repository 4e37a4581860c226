"""Callback that saves a checkpoint and ends training on a signal."""

from __future__ import annotations

import logging
import os
import signal
from pathlib import Path
from types import FrameType
from typing import Any

import lightning
from lightning.pytorch.trainer.states import TrainerFn

log = logging.getLogger(__name__)

SIGNALS = (signal.SIGTERM, signal.SIGINT, *((signal.SIGUSR1,) if hasattr(signal, "SIGUSR1") else ()))


class StopOnSignal(lightning.Callback):
    """On SIGTERM, Ctrl-C or SIGUSR1 (SLURM's notice), finishes the step, saves a checkpoint and ends normally.

    A second Ctrl-C ends at once. Outside training, signals end the process as usual.

    Args:
        folder: folder of the checkpoint; use that of the checkpoint callback.
    """

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)
        self.received = False
        self._previous: dict[signal.Signals, Any] = {}

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Installs the signal handlers for the duration of training."""
        self._previous = {number: signal.signal(number, self._note) for number in SIGNALS}

    def on_validation_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Restores the default SIGTERM outside training, where Lightning's handler would only record the signal."""
        if trainer.state.fn == TrainerFn.VALIDATING:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.received = True
        if number == signal.SIGINT:
            signal.signal(number, signal.default_int_handler)
            os.write(2, b"\nstopping after this step and saving a checkpoint; press Ctrl-C again to stop at once\n")

    def on_train_batch_end(self, trainer: lightning.Trainer, *args: Any) -> None:
        """Saves and stops at the end of the step in which a signal reached any rank."""
        # Before training starts, Lightning's own handler records a SIGTERM.
        asked = self.received or bool(getattr(trainer, "received_sigterm", False))
        if not trainer.strategy.reduce_boolean_decision(asked, all=False):
            return
        path = self.folder / f"step-{trainer.global_step}.ckpt"
        if not getattr(trainer, "fast_dev_run", False):
            trainer.save_checkpoint(path)
        trainer.limit_val_batches = 0  # should_stop alone would evaluate once more
        trainer.should_stop = True
        log.warning("stopping after a signal: saved %s; resume with ckpt=last", path)

    def teardown(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, stage: str) -> None:
        """Restores the handlers that Lightning has not restored; also runs after an error."""
        for number, handler in self._previous.items():
            if signal.getsignal(number) == self._note:
                signal.signal(number, handler)
        self._previous = {}
