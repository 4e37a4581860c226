"""Learning-rate schedule and parameter groups (paper, Implementation Details)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from torch import nn


def cosine_with_warmup(steps: int, warmup_steps: int, final_factor: float) -> Callable[[int], float]:
    """Returns a function from step to learning-rate factor: linear warm-up to 1, then cosine decay.

    Args:
        steps: total number of steps.
        warmup_steps: steps of linear warm-up.
        final_factor: factor at ``steps`` and after.
    """

    def factor(step: int) -> float:
        if step < warmup_steps:
            return (step + 1) / (warmup_steps + 1)
        progress = min(1.0, (step - warmup_steps) / max(1, steps - warmup_steps))
        return final_factor + (1 - final_factor) * 0.5 * (1 + math.cos(math.pi * progress))

    return factor


def parameter_groups(module: nn.Module, factors: Mapping[str, float] | None = None) -> list[dict[str, Any]]:
    """Splits the trainable parameters into optimiser groups; vectors (biases, norms, gains) get no weight decay.

    Args:
        module: module whose parameters to split.
        factors: learning-rate factor by name of the direct child module. Children with a factor other than 1 get groups
            of their own, with the factor as ``lr_factor``.

    Returns:
        Groups with named parameters as ``params``.
    """
    apart = {name: factor for name, factor in (factors or {}).items() if factor != 1}
    groups = []
    for child in ("", *apart):
        for decays in (True, False):
            parameters = [
                (name, parameter)
                for name, parameter in module.named_parameters()
                if parameter.requires_grad and (parameter.dim() > 1) is decays and _child(name, apart) == child
            ]
            if parameters:
                options = ({} if decays else {"weight_decay": 0.0}) | ({"lr_factor": apart[child]} if child else {})
                groups.append({"params": parameters, **options})
    return groups


def _child(name: str, apart: Mapping[str, float]) -> str:
    """The child module of a parameter's name if it is one of ``apart``, else an empty string."""
    child = name.partition(".")[0]
    return child if child in apart else ""
