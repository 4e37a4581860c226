"""The enhancement loss: re-decoded geometry should be better than the backbone's (paper, eqn enhance_loss)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor
from torch.nn import functional as F

from vg2gt.losses.geometry import TaskLoss

FORMS = ("improve", "paper_literal")
COMPARED = ("total", "reg")


@dataclass(frozen=True)
class EnhancementLoss:
    """A hinge on one task's loss before and after enhancement, for one scene.

    The paper prints ``max(0, L_before - L_after)``, which punishes improvement; its text means the opposite.

    Args:
        weight: lambda of both tasks.
        margin: by how much the loss must fall for the hinge to be at rest.
        form: ``improve``: ``max(0, L_after - L_before + margin)``; ``paper_literal``: as printed.
        on: ``total`` compares the task's whole loss, ``reg`` its plain error.

    Raises:
        ValueError: if ``form`` or ``on`` is not one of these.
    """

    weight: float = 3.0
    margin: float = 0.0
    form: str = "improve"
    on: str = "total"

    def __post_init__(self) -> None:
        if self.form not in FORMS:
            raise ValueError(f"loss.enhance.form must be one of {FORMS}, got {self.form!r}")
        if self.on not in COMPARED:
            raise ValueError(f"loss.enhance.on must be one of {COMPARED}, got {self.on!r}")

    def __call__(self, before: TaskLoss, after: TaskLoss) -> Tensor:
        """Returns the unweighted hinge, a scalar with the graph of ``after`` only."""
        reference, value = self.compared(before).detach(), self.compared(after)
        if self.form == "paper_literal":
            return F.relu(reference - value)
        return F.relu(value - reference + self.margin)

    def compared(self, task: TaskLoss) -> Tensor:
        """The part of a task's loss that is compared."""
        return task.total if self.on == "total" else task.reg
