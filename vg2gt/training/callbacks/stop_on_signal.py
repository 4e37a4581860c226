"""Saves and ends the run when the machine asks it to stop."""

from __future__ import annotations

import logging
import os
import signal
from pathlib import Path
from types import FrameType
from typing import Any

import lightning
from lightning.pytorch.trainer.states import TrainerFn

from vg2gt.training.callbacks.newest_checkpoints import evaluation_follows

log = logging.getLogger(__name__)

SIGNALS = (signal.SIGTERM, signal.SIGINT, *((signal.SIGUSR1,) if hasattr(signal, "SIGUSR1") else ()))
KEPT = "{}-kept"  # where a run goes whose folder has vanished


class StopOnSignal(lightning.Callback):
    """On SIGTERM or Ctrl-C: finishes the training step, writes a checkpoint and ends normally (``ckpt=last`` goes on).

    SIGUSR1, with which SLURM announces the end of a job's time, is answered alike; Lightning's own answer would save in
    the middle of a step. A second Ctrl-C ends at once.

    In the evaluations before and after the training there is nothing to save: the process ends with status 128 and the
    signal's number.

    A run whose folder was deleted or renamed is stopped as well, and its checkpoint saved beside the folder.

    Args:
        folder: where checkpoints are written, the same as the checkpoint callback's.
    """

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)
        self.received: int | None = None
        self._previous: dict[signal.Signals, Any] = {}

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Takes over the signals for the time of the training."""
        self._take_over()

    def on_validation_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Takes over the signals for the time of an evaluation."""
        self._take_over()

    def _take_over(self) -> None:
        for number in SIGNALS:
            if self.received is None and signal.getsignal(number) != self._note:
                self._previous[number] = signal.signal(number, self._note)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.received = number
        if number == signal.SIGINT:
            signal.signal(number, signal.default_int_handler)
            os.write(2, b"\nending after this step with a checkpoint; Ctrl-C again ends at once\n")

    def on_train_batch_end(self, trainer: lightning.Trainer, *args: Any) -> None:
        """Saves and stops at the end of the step in which a signal came or the run's folder vanished (on any rank).

        Raises:
            FileNotFoundError: if the run's folder is gone, naming where the checkpoint is.
        """
        # Lightning's own handler is in place until the training starts, and only takes a note.
        asked = self.received is not None or bool(getattr(trainer, "received_sigterm", False))
        trial = bool(getattr(trainer, "fast_dev_run", False))
        gone = not trial and not self.folder.parent.is_dir()
        if not trainer.strategy.reduce_boolean_decision(asked or gone, all=False):
            return
        gone = trainer.strategy.reduce_boolean_decision(gone, all=False)
        run = self.folder.parent
        home = run.with_name(KEPT.format(run.name)) / self.folder.name if gone else self.folder
        path = home / f"step-{trainer.global_step}.ckpt"
        if not trial:
            trainer.save_checkpoint(path)
        if gone:
            raise FileNotFoundError(
                f"{run} was deleted or renamed while the run was writing to it: saved {path}; go on in its new place "
                f"with ckpt={path}, or with name={home.parent.name} ckpt=last"
            )
        if not evaluation_follows(trainer):
            trainer.limit_val_batches = 0  # a trainer that is told to stop evaluates once more
        trainer.should_stop = True
        log.warning("stopping as asked by a signal: saved %s, go on with ckpt=last", path)

    def on_validation_batch_end(self, trainer: lightning.Trainer, *args: Any) -> None:
        """Ends the process if a signal came in an evaluation outside the training."""
        if self.received is not None and trainer.state.fn == TrainerFn.VALIDATING:
            log.warning("stopping as asked by a signal during an evaluation; a trained run goes on with ckpt=last")
            raise SystemExit(128 + self.received)

    def teardown(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, stage: str) -> None:
        """Gives back the signals that Lightning has not yet given back itself, after an error as well."""
        for number, handler in self._previous.items():
            if signal.getsignal(number) == self._note:
                signal.signal(number, handler)
        self._previous = {}
