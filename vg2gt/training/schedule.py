"""Learning-rate schedule and parameter groups (paper, Implementation Details)."""

from __future__ import annotations

import math
from collections.abc import Callable
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


def weight_decay_groups(module: nn.Module) -> list[dict[str, Any]]:
    """Splits the trainable parameters: matrices decay; biases, norms, gains and other vectors do not."""
    trainable = [parameter for parameter in module.parameters() if parameter.requires_grad]
    return [
        {"params": [parameter for parameter in trainable if parameter.dim() > 1]},
        {"params": [parameter for parameter in trainable if parameter.dim() <= 1], "weight_decay": 0.0},
    ]
