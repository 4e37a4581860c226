"""Calibration of stated errors: coverage and width of their bounds, and how well they rank the true errors."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

SHARES = 20  # steps of the sparsification curve


def stated_error_metrics(error: Tensor, bounds: Tensor, levels: Sequence[float]) -> dict[str, float]:
    """Scores stated bounds on relative errors.

    Args:
        error: ``[N]`` relative errors >= 0.
        bounds: ``[L, N]`` stated upper bounds of the errors, for each level.
        levels: nominal coverage of each level, such as 0.9.

    Returns:
        For each level, ``held_90``, the share of errors within the bound, and ``width_90``, the mean bound; and
        ``ause``, :func:`ause` of the last level's bound. NaN without pixels.
    """
    scores: dict[str, float] = {}
    for level, bound in zip(levels, bounds, strict=True):
        name = f"{100 * level:.0f}"
        scores[f"held_{name}"] = float((error <= bound).double().mean())
        scores[f"width_{name}"] = float(bound.double().mean())
    return scores | {"ause": ause(error, bounds[-1])}


def ause(error: Tensor, stated: Tensor) -> float:
    """Area under the sparsification error (Ilg et al., Uncertainty Estimates for Optical Flow, 2018).

    Removes pixels step by step, once by largest stated and once by largest true error. The area between the two curves
    of the remaining mean error is given relative to the mean error of all pixels; 0 means a perfect ranking.

    Args:
        error: ``[N]`` true errors >= 0.
        stated: ``[N]`` stated errors, which rank the pixels.
    """
    if not len(error):
        return float("nan")
    left = [max(1, round(len(error) * (1 - step / SHARES))) for step in range(SHARES)]

    def curve(order: Tensor) -> Tensor:
        """Returns the mean error of the first ``left`` pixels, relative to that of all."""
        return (error[order].double().cumsum(0)[torch.tensor(left) - 1] / torch.tensor(left)) / mean

    mean = error.double().mean().clamp(min=1e-12)
    return float((curve(stated.argsort(stable=True)) - curve(error.argsort(stable=True))).mean())
