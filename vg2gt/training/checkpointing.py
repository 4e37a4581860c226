"""Lightning checkpoints: atomic writes, and a callback that keeps the newest ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import lightning
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO
from lightning.pytorch.trainer.states import TrainerFn

from vg2gt.runs.checkpoints import by_age, read_checkpoint, write_checkpoint

BEST = "best.ckpt"


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
        every_n_train_steps: number of training steps between checkpoints; at least 1.
        save_top_k: number of checkpoints to keep; -1 keeps all.
        monitor: evaluation metric, such as ``eval/psnr``, whose best state is saved as ``best.ckpt``; None saves none.
        mode: whether ``max`` or ``min`` of the metric is best.

    Raises:
        ValueError: if ``mode`` is unknown or a number is out of range.
    """

    def __init__(
        self,
        dirpath: str,
        every_n_train_steps: int = 100,
        save_top_k: int = 3,
        monitor: str | None = None,
        mode: Literal["max", "min"] = "max",
    ) -> None:
        if mode not in ("max", "min"):
            raise ValueError(f"callbacks.checkpoint.mode is {mode!r}; choose max or min")
        if every_n_train_steps < 1 or (save_top_k < 1 and save_top_k != -1):
            raise ValueError(
                f"every_n_train_steps={every_n_train_steps} must be at least 1, save_top_k={save_top_k} at least 1, or "
                "-1 for all"
            )
        super().__init__(
            dirpath,
            "step-{step}",
            every_n_train_steps=every_n_train_steps,
            save_top_k=-1,
            auto_insert_metric_name=False,
            enable_version_counter=False,
        )
        self.kept = save_top_k
        self.watched, self.sign = monitor, 1 if mode == "max" else -1
        self.best: float | None = None

    def on_train_batch_end(self, trainer: lightning.Trainer, *args: Any, **more: Any) -> None:
        """Saves a checkpoint if one is due, then deletes all but the newest."""
        super().on_train_batch_end(trainer, *args, **more)
        if trainer.is_global_zero and self.kept > 0 and not getattr(trainer, "fast_dev_run", False):
            for path in by_age(Path(str(self.dirpath)))[self.kept :]:
                path.unlink(missing_ok=True)

    def on_validation_end(self, trainer: lightning.Trainer, *args: Any) -> None:
        """Saves the best state by the monitored metric; raises ValueError if no such metric was logged."""
        super().on_validation_end(trainer, *args)
        if self.watched is None or trainer.state.fn != TrainerFn.FITTING or getattr(trainer, "fast_dev_run", False):
            return
        if self.watched not in trainer.callback_metrics:
            known = ", ".join(sorted(name for name in trainer.callback_metrics if name.startswith("eval/")))
            raise ValueError(f"callbacks.checkpoint.monitor={self.watched} is not measured; choose one of {known}")
        value = float(trainer.callback_metrics[self.watched])
        if value == value and (self.best is None or self.sign * (value - self.best) > 0):
            self.best = value
            trainer.save_checkpoint(Path(str(self.dirpath)) / BEST)

    def state_dict(self) -> dict[str, Any]:
        """Returns Lightning's state and the best value."""
        return {**super().state_dict(), "best": self.best}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores the state; old checkpoints have no best value."""
        self.best = state_dict.pop("best", None)
        super().load_state_dict(state_dict)
