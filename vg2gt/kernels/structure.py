"""``1 - SSIM`` and its gradient in two compiled passes (:func:`vg2gt.losses.gaussian.structure_loss`)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from vg2gt.kernels.compiled import kernel, kernel_part
from vg2gt.kernels.threads import parallel_for

WINDOW, SIGMA = 11, 1.5  # kornia's Gaussian has this standard deviation for every window size
HALF = WINDOW // 2
C1, C2 = np.float32(0.01**2), np.float32(0.03**2)
TWO, ZERO, SHIFT = np.float32(2), np.float32(0), np.float32(0.5)
FAST = {"contract", "nsz", "arcp"}
_ROWS = 64  # of a plane at a time
_WEIGHTS = np.exp(-(np.arange(-HALF, HALF + 1) ** 2) / (2 * SIGMA**2))
_WEIGHTS = (_WEIGHTS / _WEIGHTS.sum()).astype(np.float32)


class Structure(torch.autograd.Function):
    """Autograd function whose forward pass computes the loss and its gradient with respect to the images."""

    @staticmethod
    def forward(ctx: Any, images: Tensor, reference: Tensor) -> Tensor:
        """Returns the loss."""
        gradient, total = np.empty(images.shape, np.float32), 0.0
        for image, other, out in zip(images.detach().numpy(), reference.detach().numpy(), gradient, strict=True):
            total += _similarity(image, other, out)  # one by one, to bound memory
        ctx.gradient = torch.from_numpy(gradient).mul_(-1 / images.numel())
        return images.new_tensor(1 - total / images.numel())

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        """Returns the gradient of the images."""
        return ctx.gradient * gradients[0], None


def _similarity(images: np.ndarray, reference: np.ndarray, gradient: np.ndarray) -> float:
    """Returns the sum of SSIM over planes ``[C, H, W]``; writes its derivative by ``images`` into ``gradient``."""
    around = ((0, 0), (HALF, HALF), (HALF, HALF))
    # variances do not depend on the shift, and those of flat bright areas lose fewer digits
    x, y = (np.pad(each - SHIFT, around, "reflect") for each in (images, reference))
    given = np.stack((x, y, x * x + y * y, x * y), 1)
    planes, height, width = images.shape
    # derivatives of SSIM by the windowed means of x, x^2 + y^2 and x y, with zeros around
    derivatives = np.zeros((planes, 3, height + 4 * HALF, width + 4 * HALF), np.float32)
    padded = np.empty_like(x)  # derivative by the padded image

    def parts(rows: int) -> list[tuple[int, int, int]]:
        starts = range(0, rows, _ROWS)
        return [(plane, first, min(first + _ROWS, rows)) for plane in range(planes) for first in starts]

    pieces = parts(height)
    totals = np.empty(len(pieces))

    def compare(piece: int) -> None:
        plane, first, last = pieces[piece]
        totals[piece] = _compare(given[plane], _WEIGHTS, derivatives[plane], first, last)

    def gather(piece: tuple[int, int, int]) -> None:
        plane, first, last = piece
        _gather(given[plane], _WEIGHTS, derivatives[plane], padded[plane], first, last)

    parallel_for(range(len(pieces)), compare)
    parallel_for(parts(height + 2 * HALF), gather)
    gradient[:] = _folded(padded)
    return float(totals.sum())


def _folded(padded: np.ndarray) -> np.ndarray:
    """Adds the reflected borders of ``[P, H + 10, W + 10]`` to the pixels that they repeat; returns ``[P, H, W]``."""
    for planes in (padded, padded.swapaxes(1, 2)):
        for k in range(1, HALF + 1):
            planes[:, HALF + k] += planes[:, HALF - k]
            planes[:, -1 - HALF - k] += planes[:, -1 - HALF + k]
    return padded[:, HALF:-HALF, HALF:-HALF]


@kernel(fastmath=FAST, error_model="numpy", nogil=True)
def _compare(given, weights, derivatives, first, last):
    """Returns the sum of SSIM over some rows of one plane.

    ``SSIM = n1 n2 / (d1 d2)`` with ``n1 = 2 u v + C1``, ``d1 = u^2 + v^2 + C1``, ``n2 = 2 (r - a b) + C2`` and
    ``d2 = s - a^2 - b^2 + C2``; a, b, s and r are the windowed means of the shifted image, the shifted reference, the
    sum of their squares and their product, and u, v are a, b without the shift. Writes the derivatives by a, s
    (doubled, because x^2 has the derivative 2 x) and r. LLVM vectorises none of the loops if they write to more arrays.
    """
    padded = given.shape[2]
    width = padded - 2 * HALF
    down, across = np.empty((4, padded), np.float32), np.empty((4, width), np.float32)
    similarity = np.empty(width, np.float32)
    total = 0.0
    for i in range(first, last):
        _down(given, weights, i, down)
        _across(down, weights, across)
        a, b, s, r = across
        for j in range(width):
            u, v = a[j] + SHIFT, b[j] + SHIFT
            top = (TWO * u * v + C1) * (TWO * (r[j] - a[j] * b[j]) + C2)
            similarity[j] = top / ((u * u + v * v + C1) * (s[j] - a[j] * a[j] - b[j] * b[j] + C2))
        row = i + 2 * HALF
        out = derivatives[0, row][2 * HALF :]
        for j in range(width):
            u, v = a[j] + SHIFT, b[j] + SHIFT
            n1, d1 = TWO * u * v + C1, u * u + v * v + C1
            n2, d2 = TWO * (r[j] - a[j] * b[j]) + C2, s[j] - a[j] * a[j] - b[j] * b[j] + C2
            of_first = v * n2 - similarity[j] * u * d2
            of_second = similarity[j] * a[j] * d1 - b[j] * n1
            out[j] = TWO * (of_first + of_second) / (d1 * d2)
        out = derivatives[1, row][2 * HALF :]
        for j in range(width):
            out[j] = -TWO * similarity[j] / (s[j] - a[j] * a[j] - b[j] * b[j] + C2)
        out = derivatives[2, row][2 * HALF :]
        for j in range(width):
            u, v = a[j] + SHIFT, b[j] + SHIFT
            out[j] = TWO * (TWO * u * v + C1) / ((u * u + v * v + C1) * (s[j] - a[j] * a[j] - b[j] * b[j] + C2))
        for j in range(width):
            total += similarity[j]
    return total


@kernel(fastmath=FAST, error_model="numpy", nogil=True)
def _gather(given, weights, derivatives, gradient, first, last):
    """Writes the derivative of the sum of SSIM by some rows of the padded image."""
    down = np.empty((3, derivatives.shape[2]), np.float32)
    across = np.empty((3, gradient.shape[1]), np.float32)
    for i in range(first, last):
        _down(derivatives, weights, i, down)
        _across(down, weights, across)
        of_mean, of_squares, of_product = across
        here, there, out = given[0, i], given[1, i], gradient[i]
        for j in range(len(out)):
            out[j] = of_mean[j] + of_squares[j] * here[j] + of_product[j] * there[j]


@kernel_part(fastmath=FAST, error_model="numpy")
def _down(given, weights, i, sums):
    """Windowed sums along the columns of ``[N, H + 10, W]`` at row i, into ``[N, W]``."""
    sums[:] = ZERO
    for k in range(WINDOW):
        weight = weights[k]
        for part in range(len(sums)):
            row, out = given[part, i + k], sums[part]
            for j in range(len(out)):
                out[j] += weight * row[j]


@kernel_part(fastmath=FAST, error_model="numpy")
def _across(given, weights, sums):
    """Windowed sums along rows ``[N, W + 10]`` into ``[N, W]``."""
    sums[:] = ZERO
    for part in range(len(sums)):
        out = sums[part]
        for k in range(WINDOW):
            weight, shifted = weights[k], given[part, k : k + len(out)]
            for j in range(len(out)):
                out[j] += weight * shifted[j]
