"""How honest stated errors are: coverage and width of their intervals, and whether large ones are where errors are."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

SHARES = 20  # steps in which pixels are left out


def stated_error_metrics(error: Tensor, bounds: Tensor, levels: Sequence[float]) -> dict[str, float]:
    """Scores the bounds that were stated of relative errors.

    Args:
        error: ``[N]`` relative errors >= 0.
        bounds: ``[L, N]`` what they were said to stay below, at each level.
        levels: how often, such as 0.9.

    Returns:
        For each level ``held_90``, the share of errors within the bound, and ``width_90``, the mean bound; and
        :func:`ause` by the last level's bound. NaN without pixels.
    """
    scores: dict[str, float] = {}
    for level, bound in zip(levels, bounds, strict=True):
        name = f"{100 * level:.0f}"
        scores[f"held_{name}"] = float((error <= bound).double().mean())
        scores[f"width_{name}"] = float(bound.double().mean())
    return scores | {"ause": ause(error, bounds[-1])}


def ause(error: Tensor, stated: Tensor) -> float:
    """Area under the sparsification error (Ilg et al., Uncertainty Estimates for Optical Flow, 2018).

    Ever more pixels are left out, those with the largest stated or the largest true error first. The area between the
    mean errors of what is left is given in mean errors of all; 0: the stated errors have the right order.

    Args:
        error: ``[N]`` true errors >= 0.
        stated: ``[N]`` what orders them.
    """
    if not len(error):
        return float("nan")
    left = [max(1, round(len(error) * (1 - step / SHARES))) for step in range(SHARES)]

    def curve(order: Tensor) -> Tensor:
        """Mean error of the first so many."""
        return (error[order].double().cumsum(0)[torch.tensor(left) - 1] / torch.tensor(left)) / mean

    mean = error.double().mean().clamp(min=1e-12)
    return float((curve(stated.argsort(stable=True)) - curve(error.argsort(stable=True))).mean())
