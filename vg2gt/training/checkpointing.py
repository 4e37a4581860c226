"""Checkpoints of a run: atomic writes, the newest ones kept, and one more on a signal."""

from __future__ import annotations

import logging
import os
import signal
from pathlib import Path
from types import FrameType
from typing import Any

import lightning
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO
from lightning.pytorch.trainer.states import TrainerFn

from vg2gt.runs.checkpoints import by_age, read_checkpoint, write_checkpoint

log = logging.getLogger(__name__)

_SIGNALS = (signal.SIGTERM, signal.SIGINT, *((signal.SIGUSR1,) if hasattr(signal, "SIGUSR1") else ()))


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes checkpoints atomically; loads only tensors and plain values (no pickled code)."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any | None = None) -> None:
        """Saves with :func:`vg2gt.runs.checkpoints.write_checkpoint`."""
        write_checkpoint(checkpoint, path)

    def load_checkpoint(self, path: Any, map_location: Any = "cpu", weights_only: bool | None = True) -> dict[str, Any]:
        """Loads on the CPU with ``weights_only=True``; ignores ``map_location`` and ``weights_only``."""
        return read_checkpoint(path)


class NewestCheckpoints(ModelCheckpoint):
    """Saves ``step-<number>.ckpt`` periodically and keeps the newest in the folder, including those of earlier runs.

    Lightning's ``monitor="step"`` skips the last step of an epoch and never deletes the checkpoint a run resumed from.

    Args:
        dirpath: folder of the checkpoints.
        every_n_train_steps: number of training steps between checkpoints.
        save_top_k: number of checkpoints to keep; -1 keeps all.
    """

    def __init__(self, dirpath: str, every_n_train_steps: int = 100, save_top_k: int = 3) -> None:
        super().__init__(
            dirpath,
            "step-{step}",
            every_n_train_steps=every_n_train_steps,
            save_top_k=-1,
            auto_insert_metric_name=False,
            enable_version_counter=False,
        )
        self.kept = save_top_k

    def on_train_batch_end(self, trainer: lightning.Trainer, *args: Any, **more: Any) -> None:
        """Saves a checkpoint if one is due, then deletes all but the newest."""
        super().on_train_batch_end(trainer, *args, **more)
        if trainer.is_global_zero and self.kept > 0 and not getattr(trainer, "fast_dev_run", False):
            for path in by_age(Path(str(self.dirpath)))[self.kept :]:
                path.unlink(missing_ok=True)


class BestCheckpoint(ModelCheckpoint):
    """Keeps the best state of the evaluations during training as ``best.ckpt``; for the arguments see Lightning."""

    def __init__(self, dirpath: str, monitor: str, mode: str = "max") -> None:
        super().__init__(dirpath, "best", monitor=monitor, mode=mode, enable_version_counter=False)


class StopOnSignal(lightning.Callback):
    """On SIGTERM, Ctrl-C or SIGUSR1 (SLURM's notice), finishes the step, saves a checkpoint and ends normally.

    A second Ctrl-C ends at once. Outside training, signals end the process at once.
    """

    def __init__(self) -> None:
        self.received = False
        self._previous: dict[signal.Signals, Any] = {}

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Installs the signal handlers for the duration of training."""
        self._previous = {number: signal.signal(number, self._note) for number in _SIGNALS}

    def on_validation_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Outside training, SIGTERM and SIGUSR1 end an evaluation at once, as there is nothing to save.

        Lightning's handler would only record a SIGTERM. After SLURM's notice, the status is 0: the job requeues itself.
        """
        if trainer.state.fn == TrainerFn.VALIDATING:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            if hasattr(signal, "SIGUSR1"):
                signal.signal(signal.SIGUSR1, _leave)
            if trainer.received_sigterm:  # while the evaluation was prepared
                signal.raise_signal(signal.SIGTERM)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.received = True
        if number == signal.SIGINT:
            signal.signal(number, signal.default_int_handler)
            os.write(2, b"\nstopping after this step and saving a checkpoint; press Ctrl-C again to stop at once\n")

    def on_train_batch_end(self, trainer: lightning.Trainer, *args: Any) -> None:
        """Saves and stops at the end of the step in which a signal reached any rank."""
        if not self._reached_any_rank(trainer):
            return
        path = Path(trainer.default_root_dir) / "checkpoints" / f"step-{trainer.global_step}.ckpt"
        if not getattr(trainer, "fast_dev_run", False):
            trainer.save_checkpoint(path)
        trainer.limit_val_batches = 0  # should_stop alone would evaluate once more
        trainer.should_stop = True
        log.warning("stopping after a signal: saved %s; resume with ckpt=last", path)

    def on_train_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Notes a signal that came after the last step, so that no evaluation follows."""
        trainer.should_stop |= self._reached_any_rank(trainer)

    def _reached_any_rank(self, trainer: lightning.Trainer) -> bool:
        # Before training starts, Lightning's own handler records a SIGTERM.
        asked = self.received or bool(getattr(trainer, "received_sigterm", False))
        return trainer.strategy.reduce_boolean_decision(asked, all=False)

    def teardown(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, stage: str) -> None:
        """Restores the handlers that Lightning has not restored; also runs after an error."""
        for number, handler in self._previous.items():
            if signal.getsignal(number) == self._note:
                signal.signal(number, handler)
        self._previous = {}


def _leave(number: int, frame: FrameType | None) -> None:
    log.warning("stopping after a signal: the evaluation is repeated when the run continues with ckpt=auto")
    raise SystemExit(0)
