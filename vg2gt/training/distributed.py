"""What the processes of a run agree on, other than gradients: values, skipped steps, their end.

A step with non-finite values is skipped on all ranks: weights and moments stay unchanged. It still counts: data, random
draws and learning rate advance, so that a resumed run sees the same steps.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import lightning
import torch
import torch.distributed
from torch import Tensor

Value = TypeVar("Value")
_KEPT = 20  # maximum number of faults in the report of a run


def world_size() -> int:
    """Returns the number of processes in the process group; 1 without one."""
    there = torch.distributed.is_available() and torch.distributed.is_initialized()
    return torch.distributed.get_world_size() if there else 1


def all_gather_object(value: Value) -> list[Value]:
    """Returns the values of all ranks, in rank order. Collective: every rank must call it."""
    if world_size() == 1:
        return [value]
    found: list[Any] = [None] * world_size()
    torch.distributed.all_gather_object(found, value)
    return found


@contextmanager
def ending_together(trainer: lightning.Trainer) -> Iterator[None]:
    """Kills the ranks that this process launched if the block raises, as they would wait forever.

    Raises:
        ChildProcessError: if a data loading process was killed.
    """
    try:
        yield
    except BaseException as error:
        if trainer.strategy.launcher is not None:
            trainer.strategy.launcher.kill(signal.SIGKILL)
        if isinstance(error, RuntimeError) and "DataLoader worker" in str(error):
            raise ChildProcessError(
                "a data loading process was killed, often because memory is full (reduce data.workers or "
                f"data.memory_mb): {str(error).splitlines()[0]}; resume with the same command and ckpt=last"
            ) from error
        raise


def finite(*tensors: Tensor) -> bool:
    """Returns whether all values are finite; synchronises with the GPU only once if they are."""
    sums = torch.stack([tensor.detach().sum().float() for tensor in tensors])  # a non-finite value makes the sum so
    return bool(sums.isfinite().all()) or all(bool(tensor.detach().isfinite().all()) for tensor in tensors)


class SkippedSteps:
    """Counts skipped steps and stops the run after too many in a row.

    Args:
        limit: number of consecutive skipped steps that stops the run; at least 1.

    Attributes:
        total: steps skipped since the run began.
        in_a_row: steps skipped since the last good step.
        faults: what was not finite in the first of them: step, rank, scenes and cause; at most 20.
    """

    def __init__(self, limit: int) -> None:
        if limit < 1:
            raise ValueError(f"training.max_skipped must be at least 1, got {limit}")
        self.limit = limit
        self.total = 0
        self.in_a_row = 0
        self.faults: list[str] = []

    def add(self, faults: list[str]) -> None:
        """Counts a skipped step; raises FloatingPointError at ``limit`` in a row."""
        self.total += 1
        self.in_a_row += 1
        self.faults = (self.faults + faults)[:_KEPT]
        if self.in_a_row >= self.limit:
            raise FloatingPointError(
                f"{self.in_a_row} steps in a row had a non-finite loss or gradient, the last: {'; '.join(faults)}. "
                "Check its scenes, lower optimizer.lr, or raise +training.max_skipped"
            )

    def state_dict(self) -> dict[str, Any]:
        """Returns plain values, for checkpoints and the report of a run."""
        return {"total": self.total, "in_a_row": self.in_a_row, "faults": self.faults}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores the counts from a checkpoint."""
        self.total, self.in_a_row, self.faults = state["total"], state["in_a_row"], state["faults"]
