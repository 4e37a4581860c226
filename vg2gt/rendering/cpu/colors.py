"""Colours of Gaussians seen from camera centres, and their gradients, in one compiled pass each."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from vg2gt.kernels.compiled import kernel, kernel_part
from vg2gt.kernels.threads import parallel_for

_CHUNK = 4096  # Gaussians
_FAST = {"contract", "nsz"}
_MOST = 16  # coefficients, of degree 3
_ZERO, _HALF, _SMALLEST = np.float32(0), np.float32(0.5), np.float32(1e-12)
_TWO, _THREE, _FOUR, _SIX, _EIGHT = np.float32(2), np.float32(3), np.float32(4), np.float32(6), np.float32(8)
# factors of the functions in vg2gt.geometry.spherical_harmonics.basis, in their order: degree 0, 1, 2 and 3
_C0, _C1, _C2 = np.float32(0.28209479177387814), np.float32(0.4886025119029199), np.float32(1.0925484305920792)
_D2 = np.float32(0.31539156525252005)
_A, _B, _E = np.float32(0.5900435899266435), np.float32(2.890611442640554), np.float32(0.4570457994644658)
_F, _H = np.float32(0.3731763325901154), np.float32(1.445305721320277)


class ViewColors(torch.autograd.Function):
    """Autograd function of :func:`vg2gt.rendering.scenes.view_colors_reference`, for float32 on a CPU."""

    @staticmethod
    def forward(ctx: Any, sh: Tensor, means: Tensor, centers: Tensor) -> Tensor:
        """Returns the colours ``[V, G, 3]``."""
        arrays = [each.detach().contiguous().numpy() for each in (sh, means, centers)]
        colors = np.empty((len(centers), len(means), 3), np.float32)

        def work(first: int) -> None:
            _colors(*arrays, colors, first, min(first + _CHUNK, len(means)))

        parallel_for(range(0, len(means), _CHUNK), work)
        ctx.arrays = arrays
        return torch.from_numpy(colors)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # type: ignore[override]
        """Returns the gradients of all arguments."""
        sh, means, centers = ctx.arrays
        of_colors = gradients[0].contiguous().numpy()
        of_sh, of_means = np.empty_like(sh), np.empty_like(means)
        chunks = range(0, len(means), _CHUNK)
        of_centers = np.zeros((len(chunks), *centers.shape))

        def work(chunk: int) -> None:
            first = chunks[chunk]
            last = min(first + _CHUNK, len(means))
            _colors_backward(sh, means, centers, of_colors, of_sh, of_means, of_centers[chunk], first, last)

        parallel_for(range(len(chunks)), work)
        sums = of_centers.sum(0).astype(np.float32)
        return torch.from_numpy(of_sh), torch.from_numpy(of_means), torch.from_numpy(sums)


@kernel_part(fastmath=_FAST, error_model="numpy")
def _direction(means, centers, n, view):
    """Unit vector from a camera centre to a Gaussian, and their distance."""
    x, y, z = means[n, 0] - centers[view, 0], means[n, 1] - centers[view, 1], means[n, 2] - centers[view, 2]
    length = max(np.sqrt(x * x + y * y + z * z), _SMALLEST)
    return x / length, y / length, z / length, length


@kernel_part(fastmath=_FAST, error_model="numpy")
def _basis(x, y, z, count, values):
    """Writes the first 1, 4, 9 or 16 functions of :func:`vg2gt.geometry.spherical_harmonics.basis`."""
    values[0] = _C0
    if count > 1:
        values[1], values[2], values[3] = -_C1 * y, _C1 * z, -_C1 * x
    if count > 4:
        xx, yy, zz = x * x, y * y, z * z
        values[4], values[5], values[7] = _C2 * x * y, -_C2 * y * z, -_C2 * x * z
        values[6], values[8] = _D2 * (zz + zz - xx - yy), _HALF * _C2 * (xx - yy)
        if count > 9:
            values[9], values[15] = -_A * y * (_THREE * xx - yy), -_A * x * (xx - _THREE * yy)
            values[10], values[14] = _B * x * y * z, _H * z * (xx - yy)
            values[11], values[13] = -_E * y * (_FOUR * zz - xx - yy), -_E * x * (_FOUR * zz - xx - yy)
            values[12] = _F * z * (_TWO * zz - _THREE * xx - _THREE * yy)


@kernel_part(fastmath=_FAST, error_model="numpy")
def _basis_gradient(x, y, z, count, dx, dy, dz):
    """Writes the derivatives of all but the first function by the direction."""
    if count > 1:
        dx[1], dy[1], dz[1] = _ZERO, -_C1, _ZERO
        dx[2], dy[2], dz[2] = _ZERO, _ZERO, _C1
        dx[3], dy[3], dz[3] = -_C1, _ZERO, _ZERO
    if count > 4:
        dx[4], dy[4], dz[4] = _C2 * y, _C2 * x, _ZERO
        dx[5], dy[5], dz[5] = _ZERO, -_C2 * z, -_C2 * y
        dx[6], dy[6], dz[6] = -_TWO * _D2 * x, -_TWO * _D2 * y, _FOUR * _D2 * z
        dx[7], dy[7], dz[7] = -_C2 * z, _ZERO, -_C2 * x
        dx[8], dy[8], dz[8] = _C2 * x, -_C2 * y, _ZERO
    if count > 9:
        xx, yy, zz = x * x, y * y, z * z
        dx[9], dy[9], dz[9] = -_SIX * _A * x * y, -_THREE * _A * (xx - yy), _ZERO
        dx[10], dy[10], dz[10] = _B * y * z, _B * x * z, _B * x * y
        dx[11], dy[11], dz[11] = _TWO * _E * x * y, -_E * (_FOUR * zz - xx - _THREE * yy), -_EIGHT * _E * y * z
        dx[12], dy[12], dz[12] = -_SIX * _F * x * z, -_SIX * _F * y * z, _F * (_SIX * zz - _THREE * xx - _THREE * yy)
        dx[13], dy[13], dz[13] = -_E * (_FOUR * zz - _THREE * xx - yy), _TWO * _E * x * y, -_EIGHT * _E * x * z
        dx[14], dy[14], dz[14] = _TWO * _H * x * z, -_TWO * _H * y * z, _H * (xx - yy)
        dx[15], dy[15], dz[15] = -_THREE * _A * (xx - yy), _SIX * _A * x * y, _ZERO


@kernel_part(fastmath=_FAST, error_model="numpy")
def _color(sh, n, values):
    """Colour of a Gaussian before it is clamped, from the values of the basis."""
    red = green = blue = _HALF
    for k in range(sh.shape[1]):
        red += values[k] * sh[n, k, 0]
        green += values[k] * sh[n, k, 1]
        blue += values[k] * sh[n, k, 2]
    return red, green, blue


@kernel(fastmath=_FAST, error_model="numpy", nogil=True)
def _colors(sh, means, centers, colors, first, last):
    count, values = sh.shape[1], np.empty(_MOST, np.float32)
    for view in range(len(centers)):
        for n in range(first, last):
            x, y, z, _ = _direction(means, centers, n, view)
            _basis(x, y, z, count, values)
            red, green, blue = _color(sh, n, values)
            colors[view, n, 0] = max(red, _ZERO)
            colors[view, n, 1] = max(green, _ZERO)
            colors[view, n, 2] = max(blue, _ZERO)


@kernel(fastmath=_FAST, error_model="numpy", nogil=True)
def _colors_backward(sh, means, centers, of_colors, of_sh, of_means, of_centers, first, last):
    count = sh.shape[1]
    values = np.empty(_MOST, np.float32)
    dx, dy, dz = np.zeros(_MOST, np.float32), np.zeros(_MOST, np.float32), np.zeros(_MOST, np.float32)
    of_sh[first:last] = _ZERO
    of_means[first:last] = _ZERO
    for view in range(len(centers)):
        for n in range(first, last):
            x, y, z, length = _direction(means, centers, n, view)
            _basis(x, y, z, count, values)
            red, green, blue = _color(sh, n, values)
            # no gradient where a colour was clamped
            of_red = of_colors[view, n, 0] if red >= _ZERO else _ZERO
            of_green = of_colors[view, n, 1] if green >= _ZERO else _ZERO
            of_blue = of_colors[view, n, 2] if blue >= _ZERO else _ZERO
            _basis_gradient(x, y, z, count, dx, dy, dz)
            gx = gy = gz = _ZERO
            for k in range(count):
                of_sh[n, k, 0] += values[k] * of_red
                of_sh[n, k, 1] += values[k] * of_green
                of_sh[n, k, 2] += values[k] * of_blue
                of_value = sh[n, k, 0] * of_red + sh[n, k, 1] * of_green + sh[n, k, 2] * of_blue
                gx += dx[k] * of_value
                gy += dy[k] * of_value
                gz += dz[k] * of_value
            along = x * gx + y * gy + z * gz
            gx, gy, gz = (gx - x * along) / length, (gy - y * along) / length, (gz - z * along) / length
            of_means[n, 0] += gx
            of_means[n, 1] += gy
            of_means[n, 2] += gz
            of_centers[view, 0] -= gx
            of_centers[view, 1] -= gy
            of_centers[view, 2] -= gz
