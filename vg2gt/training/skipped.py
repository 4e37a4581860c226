"""Skipping of training steps with non-finite values: weights and moments stay unchanged on all ranks.

A skipped step still counts: data, random draws and learning rate advance, so that a resumed run sees the same steps.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

KEPT = 20  # maximum number of faults in the report of a run


@dataclass(frozen=True)
class Fault:
    """Non-finite values that a rank found in a step.

    Attributes:
        scenes: scenes of the rank's batch.
        cause: what is not finite.
        step: step number.
        rank: rank that found it.
    """

    scenes: tuple[str, ...]
    cause: str
    step: int
    rank: int

    def __str__(self) -> str:
        return f"rank {self.rank}, {', '.join(self.scenes)}: {self.cause}"


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
        faults: first faults of the run, at most :data:`KEPT`.
    """

    def __init__(self, limit: int) -> None:
        if limit < 1:
            raise ValueError(f"training.max_skipped must be at least 1, got {limit}")
        self.limit = limit
        self.total = 0
        self.in_a_row = 0
        self.faults: list[Fault] = []

    def add(self, faults: list[Fault]) -> None:
        """Counts a skipped step; raises FloatingPointError at ``limit`` in a row."""
        self.total += 1
        self.in_a_row += 1
        self.faults = (self.faults + faults)[:KEPT]
        if self.in_a_row >= self.limit:
            raise FloatingPointError(
                f"{self.in_a_row} steps in a row had a non-finite loss or gradient, the last: "
                f"{'; '.join(map(str, faults))}. Check its scenes, lower optimizer.lr, or raise training.max_skipped"
            )

    def state_dict(self) -> dict[str, Any]:
        """Returns plain values, for checkpoints and the report of a run."""
        faults = [asdict(fault) | {"scenes": list(fault.scenes)} for fault in self.faults]
        return {"total": self.total, "in_a_row": self.in_a_row, "faults": faults}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores the counts from a checkpoint."""
        self.total, self.in_a_row = state["total"], state["in_a_row"]
        self.faults = [Fault(**{**fault, "scenes": tuple(fault["scenes"])}) for fault in state["faults"]]
