"""A step of Adam on some rows of an array in one compiled pass (:class:`vg2gt.refinement.parameters.Parameters`)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from torch import Tensor

from vg2gt.kernels.compiled import kernel
from vg2gt.kernels.threads import parallel_for

_CHUNK = 4096  # rows


def update_rows(
    value: Tensor,
    moments: tuple[Tensor, Tensor],
    grad: Tensor,
    rows: Tensor,
    corrections: Sequence[Tensor],
    unit: Tensor,
    settings: tuple[float, float, float, float],
) -> None:
    """Updates rows of a value and its moments in place (Kingma & Ba, 2015); all on the CPU and of one dtype.

    Args:
        value: ``[G, ...]`` contiguous, as are the moments.
        moments: first and second moment, of the shape of ``value``.
        grad: ``[N, ...]`` gradient of the rows.
        rows: ``[N]`` index of the rows, each at most once.
        corrections: ``[N]`` factors on the first and on the second moment that correct their bias.
        unit: ``[G]`` unit of each row of the value: the gradient is multiplied by it, and so is the change.
        settings: decay of the first and of the second moment, epsilon, learning rate.
    """
    flat = [each.view(len(each), -1).numpy() for each in (value, *moments)]
    gradient = grad.reshape(len(grad), -1).numpy()
    known = [each.numpy() for each in (rows, *corrections, unit)]
    beta, gamma, epsilon, rate = settings
    numbers = np.array((1 - beta, gamma, 1 - gamma, epsilon, rate), gradient.dtype)

    def work(first: int) -> None:
        _update(*flat, gradient, *known, numbers, first, min(first + _CHUNK, len(gradient)))

    parallel_for(range(0, len(gradient), _CHUNK), work)


@kernel(error_model="numpy", nogil=True, fastmath={"contract", "nsz"})
def _update(value, first, second, grad, rows, correct_first, correct_second, unit, numbers, begin, end):
    rest, gamma, gamma_rest, epsilon, rate = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    for i in range(begin, end):
        row = rows[i]
        scale = unit[row]
        for c in range(grad.shape[1]):
            g = grad[i, c] * scale
            mean = first[row, c] + rest * (g - first[row, c])
            square = gamma * second[row, c] + gamma_rest * g * g
            first[row, c], second[row, c] = mean, square
            step = mean * correct_first[i] / (math.sqrt(square * correct_second[i]) + epsilon)
            value[row, c] -= rate * step * scale
