"""A step of Adam on some rows of an array (:class:`vg2gt.refinement.parameters.Parameters`)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from torch import Tensor

from vg2gt.kernels.compiled import kernel
from vg2gt.kernels.threads import parallel_for

_CHUNK = 4096  # rows


class RowUpdate(NamedTuple):
    """A step of Adam (Kingma & Ba, 2015) on some rows of a value.

    Attributes:
        value: ``[G, ...]``, contiguous.
        moments: first and second moment, of the shape of ``value``.
        grad: ``[N, ...]`` gradient of the rows.
        rows: ``[N]`` index of the rows, each at most once.
        corrections: ``[N]`` factors on the first and on the second moment (:func:`bias_corrections`).
        unit: ``[G]`` unit of each row of the value: the gradient is multiplied by it, and so is the change.
        betas: decay of the first and of the second moment.
        epsilon: added to the root of the second moment.
        rate: learning rate.
    """

    value: Tensor
    moments: tuple[Tensor, Tensor]
    grad: Tensor
    rows: Tensor
    corrections: tuple[Tensor, Tensor]
    unit: Tensor
    betas: tuple[float, float]
    epsilon: float
    rate: float


def bias_corrections(counts: Tensor, betas: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """Returns the factors that correct the bias of moments after ``counts`` updates, for the first and the second."""
    return 1 / (1 - betas[0] ** counts), 1 / (1 - betas[1] ** counts)


def update_rows(update: RowUpdate) -> None:
    """Makes a step in place: in one compiled pass on a CPU, by :func:`update_rows_reference` elsewhere."""
    if update.value.device.type != "cpu":
        update_rows_reference(update)
        return
    flat = [each.view(len(each), -1).numpy() for each in (update.value, *update.moments)]
    grad = update.grad.reshape(len(update.grad), -1).numpy()
    known = [each.numpy() for each in (update.rows, *update.corrections, update.unit)]
    beta, gamma = update.betas
    numbers = np.array((1 - beta, gamma, 1 - gamma, update.epsilon, update.rate), grad.dtype)

    def work(first: int) -> None:
        _update(*flat, grad, *known, numbers, first, min(first + _CHUNK, len(grad)))

    parallel_for(range(0, len(grad), _CHUNK), work)


def update_rows_reference(update: RowUpdate) -> None:
    """Makes a step in place, in plain torch."""
    first, second = update.moments
    beta, gamma = update.betas

    def per_row(numbers: Tensor) -> Tensor:
        return numbers.view(-1, *[1] * (update.grad.dim() - 1))

    rows, unit = update.rows, per_row(update.unit[update.rows])
    grad = update.grad * unit
    first[rows] = mean = first[rows].lerp_(grad, 1 - beta)
    second[rows] = square = second[rows].mul_(gamma).addcmul_(grad, grad, value=1 - gamma)
    of_mean, of_square = map(per_row, update.corrections)
    update.value[rows] -= update.rate * mean * of_mean / (square * of_square).sqrt_().add_(update.epsilon) * unit


@kernel(error_model="numpy", nogil=True, fastmath={"contract", "nsz"})
def _update(value, first, second, grad, rows, correct_first, correct_second, unit, numbers, begin, end):
    new, gamma, new_square, epsilon, rate = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    for i in range(begin, end):
        row = rows[i]
        scale = unit[row]
        for c in range(grad.shape[1]):
            g = grad[i, c] * scale
            mean = first[row, c] + new * (g - first[row, c])
            square = gamma * second[row, c] + new_square * g * g
            first[row, c], second[row, c] = mean, square
            step = mean * correct_first[i] / (math.sqrt(square * correct_second[i]) + epsilon)
            value[row, c] -= rate * step * scale
