"""Learning-rate schedule and parameter groups (paper, Implementation Details)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from torch import nn


def cosine_with_warmup(steps: int, warmup_steps: int, final_factor: float) -> Callable[[int], float]:
    """Returns the learning-rate factor of a step: linear warm-up to 1, then cosine to ``final_factor`` at ``steps``."""

    def factor(step: int) -> float:
        if step < warmup_steps:
            return (step + 1) / (warmup_steps + 1)
        progress = min(1.0, (step - warmup_steps) / max(1, steps - warmup_steps))
        return final_factor + (1 - final_factor) * 0.5 * (1 + math.cos(math.pi * progress))

    return factor


def parameter_groups(module: nn.Module, factors: Mapping[str, float] | None = None) -> list[dict[str, Any]]:
    """Splits the trainable parameters: matrices decay; biases, norms, gains and other vectors do not.

    Args:
        module: whose parameters they are.
        factors: of the learning rate, by the names of children; groups of their own, behind the others, hold their
            parameters and say the factor as ``lr_factor``. A child that the module does not have is passed over.
    """
    apart = {name: factor for name, factor in (factors or {}).items() if factor != 1}
    groups = _by_decay(p for name, p in module.named_parameters() if name.partition(".")[0] not in apart)
    for child, factor in apart.items():
        own = _by_decay(p for name, p in module.named_parameters() if name.partition(".")[0] == child)
        groups += [group | {"lr_factor": factor} for group in own if group["params"]]
    return groups


def _by_decay(parameters: Iterable[nn.Parameter]) -> list[dict[str, Any]]:
    trainable = [parameter for parameter in parameters if parameter.requires_grad]
    return [
        {"params": [parameter for parameter in trainable if parameter.dim() > 1]},
        {"params": [parameter for parameter in trainable if parameter.dim() <= 1], "weight_decay": 0.0},
    ]
