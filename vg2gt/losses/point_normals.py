"""The point-map task's normals (VGGT's loss of point gradients; paper, Training): plain, and compiled for CPUs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vg2gt.geometry.normals import ray_slopes
from vg2gt.io.compiled import kernel, kernel_part
from vg2gt.io.threads import parallel_for
from vg2gt.losses.truth import Truth
from vg2gt.types import Cameras

POINT_STRIDES = (1, 2, 4)
CORNERS = ((1, 1), (1, -1), (-1, 1), (-1, -1))
PITCH, LINES = 256, 16  # of the compiled rows' table: depth, truth and validity of three rows, slopes, derivatives
OWN, LEFT, RIGHT, ABOVE, BELOW = (PITCH * line for line in range(11, LINES))
ONE, ZERO = np.float32(1), np.float32(0)


def point_normal_loss(depth: Tensor, cameras: Cameras, truth: Truth, valid: Tensor) -> Tensor:
    """``mean(1 - cos)`` between predicted and true surface normals at every stride, averaged over strides.

    Each pixel has four normals, one for each pair of a horizontal and a vertical neighbour (VGGT's cross products of
    the point map's differences), counted where the pixel and both neighbours are valid.

    Args:
        depth: ``[V, H, W]`` predicted, in the truth's unit.
        cameras: predicted (B = 1); where they have a gradient, or depth is not on a CPU, plain torch computes the loss.
        truth: one scene.
        valid: ``[V, H, W]`` bool.
    """
    fixed = not (cameras.world_to_camera.requires_grad or cameras.intrinsics.requires_grad)
    if fixed and depth.device.type == "cpu" and depth.dtype in (torch.float32, torch.float64):
        return _PointNormals.apply(depth, cameras, truth, valid)
    return point_normal_reference(depth, cameras, truth, valid)


def point_normal_reference(depth: Tensor, cameras: Cameras, truth: Truth, valid: Tensor) -> Tensor:
    """:func:`point_normal_loss` in plain torch, for any device and with gradients of the cameras as well."""
    turn = _turn(cameras, truth)
    total = depth.new_zeros(())
    for stride in POINT_STRIDES:
        mask = valid[:, ::stride, ::stride]
        predicted = _corner_normals(depth, cameras.intrinsics[0], stride)
        expected = _corner_normals(truth.depth[0], truth.cameras.intrinsics[0], stride)
        disagreement, count = depth.new_zeros(()), mask.new_zeros((), dtype=torch.long)
        for corner, (x, y, z), n in zip(CORNERS, predicted, expected, strict=True):
            n = turn @ torch.stack(n, 1).flatten(2)
            n = (n / n.square().sum(1, keepdim=True).sqrt()).unflatten(2, x.shape[1:])
            cosine = (x * n[:, 0] + y * n[:, 1] + z * n[:, 2]) / (x * x + y * y + z * z).sqrt()
            both = _corner_mask(mask, corner)
            disagreement = disagreement + ((1 - cosine) * both).sum()
            count = count + both.sum()
        total = total + disagreement / count.clamp(min=1)
    return total / len(POINT_STRIDES)


def _corner(image: Tensor, corner: tuple[int, int]) -> Tensor:
    """The pixels of an image ``[..., H, W]`` that have neighbours on the corner's sides (right/left, down/up)."""
    across, down = corner
    rows = slice(None, -1) if down > 0 else slice(1, None)
    columns = slice(None, -1) if across > 0 else slice(1, None)
    return image[..., rows, columns]


def _corner_mask(valid: Tensor, corner: tuple[int, int]) -> Tensor:
    across, down = corner
    horizontal = _corner(valid, (-across, down))
    vertical = _corner(valid, (across, -down))
    return _corner(valid, corner) & horizontal & vertical


def _corner_normals(depth: Tensor, intrinsics: Tensor, stride: int) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Camera-frame normals of the strided depth ``[V, H, W]``, components ``[V, h - 1, w - 1]``, corner by corner.

    The differences to the neighbours, ``(d1 - d) r + d1 / fx e_x`` and its like, have the cross product derived in
    :mod:`vg2gt.geometry.normals` with ``gx = fx (d1 - d) / d1``. Not of unit length.
    """
    u, v = ray_slopes(intrinsics, (depth.shape[-2], depth.shape[-1]))
    u, v = u[..., ::stride], v[..., ::stride, :]
    depth = depth[:, ::stride, ::stride]
    fx, fy = intrinsics[:, 0, 0, None, None] / stride, intrinsics[:, 1, 1, None, None] / stride
    difference_x, difference_y = fx * (depth[..., 1:] - depth[..., :-1]), fy * (depth[:, 1:] - depth[:, :-1])
    slope_x = {1: difference_x / depth[..., 1:], -1: difference_x / depth[..., :-1]}
    slope_y = {1: difference_y / depth[:, 1:], -1: difference_y / depth[:, :-1]}
    for across, down in CORNERS:
        rows = slice(None, -1) if down > 0 else slice(1, None)
        columns = slice(None, -1) if across > 0 else slice(1, None)
        gx, gy = slope_x[across][:, rows], slope_y[down][..., columns]
        yield gx, gy, -1 - u[..., columns] * gx - v[..., rows, :] * gy


def _turn(cameras: Cameras, truth: Truth) -> Tensor:
    """Rotations ``[V, 3, 3]`` from the true cameras' frames into the predicted ones'."""
    return cameras.world_to_camera[0, :, :3, :3] @ truth.cameras.world_to_camera[0, :, :3, :3].transpose(-1, -2)


class _PointNormals(torch.autograd.Function):
    """The kernels as one operation: value and gradient of the depth come out of one pass."""

    @staticmethod
    def forward(ctx: Any, depth: Tensor, cameras: Cameras, truth: Truth, valid: Tensor) -> Tensor:
        """The loss."""
        maps = [values.detach().contiguous().numpy() for values in (depth, truth.depth[0].to(depth), valid)]
        pinholes = [_pinholes(c.intrinsics[0].to(depth)) for c in (cameras, truth.cameras)]
        turn = _turn(cameras, truth).detach().to(depth).contiguous().numpy()
        counts = [_count_corners(valid, stride) for stride in POINT_STRIDES]
        weights = np.array([1 / (max(count, 1) * len(POINT_STRIDES)) for count in counts])
        gradient, totals = np.zeros_like(maps[0]), np.zeros(len(maps[0]))
        tables = np.zeros((len(totals), LINES * PITCH), gradient.dtype)
        arrays = (*maps, *pinholes, turn, np.array(POINT_STRIDES), weights, tables, gradient, totals)
        parallel_for(range(len(totals)), lambda view: _disagreement(view, *arrays))
        ctx.gradient = torch.from_numpy(gradient)
        return depth.new_tensor(totals.sum())

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None, None]:  # type: ignore[override]
        """Gradient of the depth."""
        return ctx.gradient * gradients[0], None, None, None


def _pinholes(intrinsics: Tensor) -> np.ndarray:
    """``[V, 4]`` focal lengths and principal points."""
    columns = [intrinsics[:, row, column] for row, column in ((0, 0), (1, 1), (0, 2), (1, 2))]
    return torch.stack(columns, -1).detach().numpy()


def _count_corners(valid: Tensor, stride: int) -> int:
    """Corners of ``valid`` ``[V, H, W]`` at a stride whose pixel and both neighbours are valid.

    Every square of four neighbours has four corners; one of them is left where one pixel is not valid, none otherwise.
    """
    pixels = valid[:, ::stride, ::stride].to(torch.uint8)
    pairs = pixels[:, 1:] + pixels[:, :-1]
    squares = pairs[..., 1:] + pairs[..., :-1]
    return 4 * int((squares == 4).sum()) + int((squares == 3).sum())


@kernel(fastmath={"contract", "nsz", "arcp", "reassoc"}, error_model="numpy", nogil=True)
def _disagreement(view, depth, true, valid, pinholes, true_pinholes, turn, strides, weights, tables, gradient, totals):
    """``sum weight (1 - cos)`` of one view's corners at all strides; its derivative is added to ``gradient``.

    ``depth``, ``true``, ``valid``, ``gradient`` are ``[V, H, W]``, the pinholes ``[V, 4]`` (fx, fy, cx, cy in pixels),
    ``turn`` is ``[V, 3, 3]``, ``weights`` one a stride, ``totals`` ``[V]``. Rows are worked on in pieces that are first
    copied into the view's own of the ``tables`` ``[V, LINES PITCH]``, whose lines the compiler knows to be apart: so it
    makes vector instructions. Invalid pixels, and the columns beside the image, are copied as depth one that does not
    count.
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
            for begin in range(0, width, stride * (PITCH - 2)):
                columns = min((width - begin + stride - 1) // stride, PITCH - 2)
                for line in range(3):
                    row = i + (line - 1) * stride
                    inside = 0 <= row < height
                    for k in range(columns + 2):
                        j = begin + (k - 1) * stride
                        counts = inside and 0 <= j < width and valid[view, row, j]
                        table[line * PITCH + k] = depth[view, row, j] if counts else ONE
                        table[(3 + line) * PITCH + k] = true[view, row, j] if counts else ONE
                        table[(6 + line) * PITCH + k] = ONE if counts else ZERO
                for k in range(columns + 2):
                    j = begin + (k - 1) * stride
                    table[9 * PITCH + k] = (j - cx) / fx
                    table[10 * PITCH + k] = (j - hx) / gx
                sums += _row(table, columns, v, w, fx / stride, fy / stride, gx / stride, gy / stride, turn[view])
                for k in range(1, columns + 1):
                    j = begin + (k - 1) * stride
                    gradient[view, i, j] += weight * table[OWN + k]
                    if k > 1 or begin > 0:
                        gradient[view, i, j - stride] -= weight * table[LEFT + k]
                    if j + stride < width:
                        gradient[view, i, j + stride] -= weight * table[RIGHT + k]
                if i >= stride:
                    for k in range(1, columns + 1):
                        gradient[view, i - stride, begin + (k - 1) * stride] -= weight * table[ABOVE + k]
                if i + stride < height:
                    for k in range(1, columns + 1):
                        gradient[view, i + stride, begin + (k - 1) * stride] -= weight * table[BELOW + k]
        totals[view] += weight * sums


@kernel_part(fastmath={"contract", "nsz", "arcp", "reassoc"}, error_model="numpy")
def _row(table, columns, v, w, sx, sy, tx, ty, r):
    """``sum 1 - cos`` over a row's corners; writes their derivatives into the table's last five lines.

    The normals are those of :func:`_corner_normals`: x, y, z predicted, ex, ey, ez true.
    """
    total = ZERO
    for k in range(1, columns + 1):
        u, q = table[9 * PITCH + k], table[10 * PITCH + k]
        here, there = table[PITCH + k], table[4 * PITCH + k]
        left, right, above, below = table[PITCH + k - 1], table[PITCH + k + 1], table[k], table[2 * PITCH + k]
        x0, x1 = sx * (here - left) / left, sx * (right - here) / right
        y0, y1 = sy * (here - above) / above, sy * (below - here) / below
        east, west = table[4 * PITCH + k + 1], table[4 * PITCH + k - 1]
        north, south = table[3 * PITCH + k], table[5 * PITCH + k]
        ex0, ex1 = tx * (there - west) / west, tx * (east - there) / east
        ey0, ey1 = ty * (there - north) / north, ty * (south - there) / south
        own = table[7 * PITCH + k]
        m_left, m_right = own * table[7 * PITCH + k - 1], own * table[7 * PITCH + k + 1]
        m_above, m_below = table[6 * PITCH + k], table[8 * PITCH + k]
        c0, ax0, ay0 = _turn_of_corner(x0, y0, ex0, ey0, u, v, q, w, r, m_left * m_above)
        c1, ax1, ay1 = _turn_of_corner(x1, y0, ex1, ey0, u, v, q, w, r, m_right * m_above)
        c2, ax2, ay2 = _turn_of_corner(x0, y1, ex0, ey1, u, v, q, w, r, m_left * m_below)
        c3, ax3, ay3 = _turn_of_corner(x1, y1, ex1, ey1, u, v, q, w, r, m_right * m_below)
        total += (c0 + c1) + (c2 + c3)
        of_left, of_right = -(ax0 + ax2) * sx / left, (ax1 + ax3) * sx / right
        of_above, of_below = -(ay0 + ay1) * sy / above, (ay2 + ay3) * sy / below
        table[OWN + k] = (of_left + of_right) + (of_above + of_below)
        table[LEFT + k] = of_left * here / left
        table[RIGHT + k] = of_right * here / right
        table[ABOVE + k] = of_above * here / above
        table[BELOW + k] = of_below * here / below
    return total


@kernel_part(fastmath={"contract", "nsz", "arcp", "reassoc"}, error_model="numpy", forceinline=True)
def _turn_of_corner(x, y, ex, ey, u, v, q, w, r, counts):
    """``1 - cos`` of one corner and minus its derivatives by ``x`` and ``y``, all times ``counts``."""
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
