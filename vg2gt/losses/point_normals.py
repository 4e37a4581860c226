"""The point-map task's normals (VGGT's loss of point gradients; paper, Training): plain, and compiled for CPUs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vg2gt.geometry.normals import ray_slopes
from vg2gt.io.compiled import kernel
from vg2gt.losses.truth import Truth
from vg2gt.types import Cameras

POINT_STRIDES = (1, 2, 4)
CORNERS = ((1, 1), (1, -1), (-1, 1), (-1, -1))


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
    """The kernel as one operation: value and gradient of the depth come out of one pass."""

    @staticmethod
    def forward(ctx: Any, depth: Tensor, cameras: Cameras, truth: Truth, valid: Tensor) -> Tensor:
        """The loss."""
        maps = [values.detach().contiguous().numpy() for values in (depth, truth.depth[0].to(depth), valid)]
        pinholes = [_pinholes(c.intrinsics[0].to(depth)) for c in (cameras, truth.cameras)]
        turn = _turn(cameras, truth).detach().to(depth).contiguous().numpy()
        gradient = np.zeros_like(maps[0])
        total = 0.0
        for stride in POINT_STRIDES:
            total += _disagreement(*maps, *pinholes, turn, stride, len(POINT_STRIDES), gradient)
        ctx.gradient = torch.from_numpy(gradient)
        return depth.new_tensor(total)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None, None]:  # type: ignore[override]
        """Gradient of the depth."""
        return ctx.gradient * gradients[0], None, None, None


def _pinholes(intrinsics: Tensor) -> np.ndarray:
    """``[V, 4]`` focal lengths and principal points."""
    columns = [intrinsics[:, row, column] for row, column in ((0, 0), (1, 1), (0, 2), (1, 2))]
    return torch.stack(columns, -1).detach().numpy()


@kernel(fastmath={"contract", "nsz", "arcp"}, error_model="numpy", nogil=True)
def _disagreement(depth, true, valid, pinholes, true_pinholes, turn, stride, strides, gradient):
    """``mean(1 - cos) / strides`` of one stride; its derivative is added to ``gradient``.

    ``depth``, ``true``, ``valid``, ``gradient`` are ``[V, H, W]``, the pinholes ``[V, 4]`` (fx, fy, cx, cy in pixels),
    ``turn`` is ``[V, 3, 3]``. The normals are those of :func:`_corner_normals`: x, y, z predicted, ex, ey, ez true.
    """
    views, height, width = depth.shape
    count = 0
    for view in range(views):
        for i in range(0, height, stride):
            for j in range(0, width, stride):
                if valid[view, i, j]:
                    across = int(j + stride < width and valid[view, i, j + stride])
                    across += int(j >= stride and valid[view, i, j - stride])
                    down = int(i + stride < height and valid[view, i + stride, j])
                    down += int(i >= stride and valid[view, i - stride, j])
                    count += across * down
    if count == 0:
        return 0.0
    weight = 1.0 / (count * strides)
    total = 0.0
    for view in range(views):
        fx, fy, cx, cy = pinholes[view]
        gx, gy, hx, hy = true_pinholes[view]
        sx, sy, tx, ty = fx / stride, fy / stride, gx / stride, gy / stride
        r = turn[view]
        for i in range(0, height, stride):
            v, w = (i - cy) / fy, (i - hy) / gy
            for j in range(0, width, stride):
                if not valid[view, i, j]:
                    continue
                u, q = (j - cx) / fx, (j - hx) / gx
                here, there = depth[view, i, j], true[view, i, j]
                own = 0.0
                for a in (1, -1):
                    column = j + a * stride
                    if column < 0 or column >= width or not valid[view, i, column]:
                        continue
                    beside = depth[view, i, column]
                    x = a * sx * (1.0 - here / beside)
                    ex = a * tx * (1.0 - there / true[view, i, column])
                    slope_x = a * sx / beside
                    for b in (1, -1):
                        row = i + b * stride
                        if row < 0 or row >= height or not valid[view, row, j]:
                            continue
                        above = depth[view, row, j]
                        y = b * sy * (1.0 - here / above)
                        z = -1.0 - u * x - v * y
                        ey = b * ty * (1.0 - there / true[view, row, j])
                        ez = -1.0 - q * ex - w * ey
                        nx = r[0, 0] * ex + r[0, 1] * ey + r[0, 2] * ez
                        ny = r[1, 0] * ex + r[1, 1] * ey + r[1, 2] * ez
                        nz = r[2, 0] * ex + r[2, 1] * ey + r[2, 2] * ez
                        square = x * x + y * y + z * z
                        scale = 1.0 / np.sqrt(square * (ex * ex + ey * ey + ez * ez))
                        cosine = (x * nx + y * ny + z * nz) * scale
                        total += 1.0 - cosine
                        fall = cosine / square
                        along_z = nz * scale - z * fall
                        along_x = (nx * scale - x * fall - u * along_z) * slope_x * weight
                        along_y = (ny * scale - y * fall - v * along_z) * (b * sy / above) * weight
                        own += along_x + along_y
                        gradient[view, i, column] -= along_x * (here / beside)
                        gradient[view, row, j] -= along_y * (here / above)
                gradient[view, i, j] += own
    return total * weight
