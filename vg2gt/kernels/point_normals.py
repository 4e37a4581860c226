"""The surface normal loss and its gradient in one compiled pass (:mod:`vg2gt.losses.geometry`)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from vg2gt.kernels.compiled import kernel, kernel_part
from vg2gt.kernels.threads import parallel_for

_PITCH, LINES = 256, 16  # a view's table: depth, truth and validity of three rows each, ray slopes, derivatives
OWN, _LEFT, _RIGHT, _ABOVE, _BELOW = (_PITCH * line for line in range(11, LINES))
ONE, ZERO = np.float32(1), np.float32(0)


class PointNormals(torch.autograd.Function):
    """Autograd function whose forward pass computes the loss and its gradient with respect to depth."""

    @staticmethod
    def forward(
        ctx: Any, depth: Tensor, true: Tensor, valid: Tensor, intrinsics: Tensor, true_intrinsics: Tensor, turn: Tensor,
        strides: tuple[int, ...],
    ) -> Tensor:  # fmt: skip
        """Returns the loss of depth ``[V, H, W]``; ``turn`` ``[V, 3, 3]`` rotates true to predicted camera frames."""
        maps = [values.detach().contiguous().numpy() for values in (depth, true.to(depth), valid)]
        pinholes = [_pinholes(matrix.to(depth)) for matrix in (intrinsics, true_intrinsics)]
        turn = turn.detach().to(depth).contiguous()
        counts = [_count_corners(valid, stride) for stride in strides]
        weights = np.array([1 / (max(count, 1) * len(strides)) for count in counts])
        gradient, totals = np.zeros_like(maps[0]), np.zeros(len(maps[0]))
        tables = np.zeros((len(totals), LINES * _PITCH), gradient.dtype)
        arrays = (*maps, *pinholes, turn.numpy(), np.array(strides), weights, tables, gradient, totals)
        parallel_for(range(len(totals)), lambda view: _disagreement(view, *arrays))
        ctx.gradient = torch.from_numpy(gradient)
        return depth.new_tensor(totals.sum())

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        """Returns the gradient of the depth."""
        return ctx.gradient * gradients[0], *[None] * 6


def _pinholes(intrinsics: Tensor) -> np.ndarray:
    """Returns ``[V, 4]`` focal lengths and principal points (fx, fy, cx, cy)."""
    columns = [intrinsics[:, row, column] for row, column in ((0, 0), (1, 1), (0, 2), (1, 2))]
    return torch.stack(columns, -1).detach().numpy()


def _count_corners(valid: Tensor, stride: int) -> int:
    """Counts corners of ``valid`` ``[V, H, W]`` at a stride: four per square of valid pixels, one if one is invalid."""
    pixels = valid[:, ::stride, ::stride].to(torch.uint8)
    pairs = pixels[:, 1:] + pixels[:, :-1]
    squares = pairs[..., 1:] + pairs[..., :-1]
    return 4 * int((squares == 4).sum()) + int((squares == 3).sum())


@kernel(fastmath={"contract", "nsz", "arcp", "reassoc"}, error_model="numpy", nogil=True)
def _disagreement(view, depth, true, valid, pinholes, true_pinholes, turn, strides, weights, tables, gradient, totals):
    """Adds one view's ``sum weight (1 - cos)`` over corners and strides to ``totals``, its derivative to ``gradient``.

    Rows are processed in pieces, which are first copied into the view's row of ``tables`` ``[V, LINES _PITCH]``. The
    compiler knows that the lines of a table do not overlap, so it vectorises. Invalid pixels are copied as depth one
    with validity zero.
    """
    height, width = valid.shape[1:]
    table = tables[view]
    fx, fy, cx, cy = pinholes[view]
    gx, gy, hx, hy = true_pinholes[view]
    for level in range(len(strides)):
        stride = strides[level]
        weight = weights[level]
        sums = 0.0
        for i in range(0, height, stride):
            v, w = (i - cy) / fy, (i - hy) / gy
            for begin in range(0, width, stride * (_PITCH - 2)):
                columns = min((width - begin + stride - 1) // stride, _PITCH - 2)
                for line in range(3):
                    row = i + (line - 1) * stride
                    inside = 0 <= row < height
                    for k in range(columns + 2):
                        j = begin + (k - 1) * stride
                        counts = inside and 0 <= j < width and valid[view, row, j]
                        table[line * _PITCH + k] = depth[view, row, j] if counts else ONE
                        table[(3 + line) * _PITCH + k] = true[view, row, j] if counts else ONE
                        table[(6 + line) * _PITCH + k] = ONE if counts else ZERO
                for k in range(columns + 2):
                    j = begin + (k - 1) * stride
                    table[9 * _PITCH + k] = (j - cx) / fx
                    table[10 * _PITCH + k] = (j - hx) / gx
                sums += _row(table, columns, v, w, fx / stride, fy / stride, gx / stride, gy / stride, turn[view])
                for k in range(1, columns + 1):
                    j = begin + (k - 1) * stride
                    gradient[view, i, j] += weight * table[OWN + k]
                    if k > 1 or begin > 0:
                        gradient[view, i, j - stride] -= weight * table[_LEFT + k]
                    if j + stride < width:
                        gradient[view, i, j + stride] -= weight * table[_RIGHT + k]
                if i >= stride:
                    for k in range(1, columns + 1):
                        gradient[view, i - stride, begin + (k - 1) * stride] -= weight * table[_ABOVE + k]
                if i + stride < height:
                    for k in range(1, columns + 1):
                        gradient[view, i + stride, begin + (k - 1) * stride] -= weight * table[_BELOW + k]
        totals[view] += weight * sums


@kernel_part(fastmath={"contract", "nsz", "arcp", "reassoc"}, error_model="numpy")
def _row(table, columns, v, w, sx, sy, tx, ty, r):
    """Returns ``sum 1 - cos`` over a row's corners; writes their derivatives into the table's last five lines.

    The normals are those of ``vg2gt.losses.geometry._corner_normals``: x, y, z predicted, ex, ey, ez true.
    """
    total = ZERO
    for k in range(1, columns + 1):
        u, q = table[9 * _PITCH + k], table[10 * _PITCH + k]
        here, there = table[_PITCH + k], table[4 * _PITCH + k]
        left, right, above, below = table[_PITCH + k - 1], table[_PITCH + k + 1], table[k], table[2 * _PITCH + k]
        x0, x1 = sx * (here - left) / left, sx * (right - here) / right
        y0, y1 = sy * (here - above) / above, sy * (below - here) / below
        east, west = table[4 * _PITCH + k + 1], table[4 * _PITCH + k - 1]
        north, south = table[3 * _PITCH + k], table[5 * _PITCH + k]
        ex0, ex1 = tx * (there - west) / west, tx * (east - there) / east
        ey0, ey1 = ty * (there - north) / north, ty * (south - there) / south
        own = table[7 * _PITCH + k]
        m_left, m_right = own * table[7 * _PITCH + k - 1], own * table[7 * _PITCH + k + 1]
        m_above, m_below = table[6 * _PITCH + k], table[8 * _PITCH + k]
        c0, ax0, ay0 = _turn_of_corner(x0, y0, ex0, ey0, u, v, q, w, r, m_left * m_above)
        c1, ax1, ay1 = _turn_of_corner(x1, y0, ex1, ey0, u, v, q, w, r, m_right * m_above)
        c2, ax2, ay2 = _turn_of_corner(x0, y1, ex0, ey1, u, v, q, w, r, m_left * m_below)
        c3, ax3, ay3 = _turn_of_corner(x1, y1, ex1, ey1, u, v, q, w, r, m_right * m_below)
        total += (c0 + c1) + (c2 + c3)
        of_left, of_right = -(ax0 + ax2) * sx / left, (ax1 + ax3) * sx / right
        of_above, of_below = -(ay0 + ay1) * sy / above, (ay2 + ay3) * sy / below
        table[OWN + k] = (of_left + of_right) + (of_above + of_below)
        table[_LEFT + k] = of_left * here / left
        table[_RIGHT + k] = of_right * here / right
        table[_ABOVE + k] = of_above * here / above
        table[_BELOW + k] = of_below * here / below
    return total


@kernel_part(fastmath={"contract", "nsz", "arcp", "reassoc"}, error_model="numpy", forceinline=True)
def _turn_of_corner(x, y, ex, ey, u, v, q, w, r, counts):
    """Returns ``1 - cos`` of one corner and its negated derivatives by ``x`` and ``y``, all times ``counts``."""
    z = -ONE - u * x - v * y
    ez = -ONE - q * ex - w * ey
    nx = r[0, 0] * ex + r[0, 1] * ey + r[0, 2] * ez
    ny = r[1, 0] * ex + r[1, 1] * ey + r[1, 2] * ez
    nz = r[2, 0] * ex + r[2, 1] * ey + r[2, 2] * ez
    square = x * x + y * y + z * z
    scale = ONE / np.sqrt(square * (ex * ex + ey * ey + ez * ez))
    cosine = (x * nx + y * ny + z * nz) * scale
    fall = cosine / square
    along_z = nz * scale - z * fall
    along_x = nx * scale - x * fall - u * along_z
    along_y = ny * scale - y * fall - v * along_z
    return (ONE - cosine) * counts, along_x * counts, along_y * counts
