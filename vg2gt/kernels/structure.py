"""``1 - SSIM`` and its gradient in one compiled pass (:func:`vg2gt.losses.gaussian.structure_loss`)."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vg2gt.kernels.compiled import kernel
from vg2gt.kernels.threads import parallel_for

WINDOW, SIGMA = 11, 1.5  # kornia's Gaussian has this standard deviation for every window size
HALF = WINDOW // 2
C1, C2 = np.float32(0.01**2), np.float32(0.03**2)
Bands = tuple[np.ndarray, np.ndarray]
ONE, TWO, ZERO = np.float32(1), np.float32(2), np.float32(0)


class Structure(torch.autograd.Function):
    """Autograd function whose forward pass computes the loss and its gradient with respect to the images."""

    @staticmethod
    def forward(ctx: Any, images: Tensor, reference: Tensor) -> Tensor:
        """Returns the loss."""
        planes = [tensor.detach().flatten(0, 1).contiguous().numpy() for tensor in (images, reference)]
        gradient = np.empty_like(planes[0])
        totals = np.empty(len(gradient))
        rows, columns = (_bands(size) for size in gradient.shape[1:])

        def work(plane: int) -> None:
            totals[plane] = _similarity(planes[0][plane], planes[1][plane], rows, columns, gradient[plane])

        parallel_for(range(len(totals)), work)
        gradient *= np.float32(-1 / gradient.size)
        ctx.gradient = torch.from_numpy(gradient).view(images.shape)
        return images.new_tensor(1 - totals.sum() / gradient.size)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        """Returns the gradient of the images."""
        return ctx.gradient * gradients[0], None


@lru_cache(maxsize=16)
def _bands(size: int) -> Bands:
    """Returns diagonals ``[11, n]`` of the window's matrix along an axis (borders reflected) and of its transpose."""
    weights = np.exp(-(np.arange(-HALF, HALF + 1) ** 2) / (2 * SIGMA**2))
    matrix = np.zeros((size, size))
    for place in range(size):
        for weight, source in zip(weights / weights.sum(), range(place - HALF, place + HALF + 1), strict=True):
            reflected = abs(source) if source < size else 2 * (size - 1) - source
            matrix[place, reflected] += weight
    places, padded = np.arange(size), np.zeros((2, size, size + 2 * HALF))
    padded[:, :, HALF:-HALF] = matrix, matrix.T
    first, second = np.stack([padded[:, places, places + k] for k in range(WINDOW)], 1)
    return first.astype(np.float32), second.astype(np.float32)


def _similarity(x: np.ndarray, y: np.ndarray, rows: Bands, columns: Bands, gradient: np.ndarray) -> float:
    """Returns the sum of one plane's SSIM; writes its derivative by ``x`` ``[H, W]`` into ``gradient``."""
    means = [_window(values, rows[0], columns[0]) for values in (x, y, x * x, y * y, x * y)]
    total = _combine(*(mean.ravel() for mean in means))
    of_mean, of_square, of_product = (_window(means[part], rows[1], columns[1]) for part in (0, 2, 4))
    of_square *= x
    of_product *= y
    np.add(of_mean, of_square, out=gradient)
    gradient += of_product
    return total


def _window(values: np.ndarray, down: np.ndarray, across: np.ndarray) -> np.ndarray:
    out = np.empty_like(values)
    _blur(values, down, across, np.zeros(values.shape[1] + 2 * HALF, np.float32), out)
    return out


@kernel(fastmath={"contract", "nsz", "arcp"}, error_model="numpy", nogil=True)
def _combine(a, b, p, q, r):
    """Returns the sum of SSIM from windowed means of image, reference, their squares and product, ``[H W]`` each.

    ``SSIM = (2 a b + C1) (2 (r - a b) + C2) / ((a^2 + b^2 + C1) (p - a^2 + q - b^2 + C2))``. Its derivatives by a, p
    (doubled, because x^2 has the derivative 2 x) and r overwrite a, p and r.
    """
    total = 0.0
    for pixel in range(len(a)):
        x, y = a[pixel], b[pixel]
        n1, d1 = TWO * x * y + C1, x * x + y * y + C1
        n2, d2 = TWO * (r[pixel] - x * y) + C2, (p[pixel] - x * x) + (q[pixel] - y * y) + C2
        share = ONE / (d1 * d2)
        similarity = n1 * n2 * share
        total += similarity
        a[pixel] = TWO * share * (y * (n2 - n1) + x * similarity * (d1 - d2))
        p[pixel] = -TWO * similarity * share * d1
        r[pixel] = TWO * share * n1
    return total


@kernel(fastmath={"contract", "nsz", "arcp"}, error_model="numpy", nogil=True)
def _blur(source, down, across, line, out):
    """Filters ``source`` ``[H, W]`` into ``out``; ``line`` ``[W + 10]`` is scratch memory with zeros at both ends."""
    height, width = source.shape
    for i in range(height):
        for j in range(width):
            line[HALF + j] = ZERO
        for k in range(max(0, HALF - i), min(WINDOW, height + HALF - i)):
            weight, row = down[k, i], i + k - HALF
            for j in range(width):
                line[HALF + j] += weight * source[row, j]
        for j in range(width):
            out[i, j] = ZERO
        for k in range(WINDOW):
            for j in range(width):
                out[i, j] += across[k, j] * line[k + j]
