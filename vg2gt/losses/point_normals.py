"""The point-map task's normals (VGGT's loss of point gradients; paper, Training): plain, and compiled for CPUs."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from vg2gt.geometry.normals import ray_slopes
from vg2gt.kernels.point_normals import PointNormals
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
        intrinsics = (cameras.intrinsics[0], truth.cameras.intrinsics[0])
        return PointNormals.apply(depth, truth.depth[0], valid, *intrinsics, _turn(cameras, truth), POINT_STRIDES)
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
