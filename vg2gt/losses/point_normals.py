"""The point-map task's normals (VGGT's loss of point gradients; paper, Training): plain, and compiled for CPUs."""

from __future__ import annotations

import torch
from torch import Tensor

from vg2gt.geometry.normals import ray_slopes
from vg2gt.kernels.point_normals import PointNormals
from vg2gt.losses.truth import Truth
from vg2gt.types import Cameras

POINT_STRIDES = (1, 2, 4)


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
        predicted = _corner_normals(depth, cameras.intrinsics[0], stride)
        true = _corner_normals(truth.depth[0], truth.cameras.intrinsics[0], stride)
        true = (turn @ true.flatten(4)).view_as(true)
        lengths = (predicted.square().sum(3) * true.square().sum(3)).sqrt()
        cosine = (predicted * true).sum(3) / lengths  # [2, 2, V, h - 1, w - 1]
        mask = valid[:, ::stride, ::stride]
        across, down = mask[..., 1:] & mask[..., :-1], mask[:, 1:] & mask[:, :-1]
        both = _at_corners(across, -2)[None] & _at_corners(down, -1)[:, None]
        total = total + ((1 - cosine) * both).sum() / both.sum().clamp(min=1)
    return total / len(POINT_STRIDES)


def _at_corners(between: Tensor, dim: int) -> Tensor:
    """What lies between neighbours along one axis, at a corner's pixel of two along the other one: ``[2, ...]``."""
    count = between.shape[dim] - 1
    return torch.stack((between.narrow(dim, 0, count), between.narrow(dim, 1, count)))


def _corner_normals(depth: Tensor, intrinsics: Tensor, stride: int) -> Tensor:
    """Camera-frame normals ``[2, 2, V, 3, h - 1, w - 1]`` of the strided depth ``[V, H, W]`` at its squares' corners.

    The first two axes say whether the pixel's neighbours are to its right or left, below or above it. As in
    :mod:`vg2gt.geometry.normals`, with ``gx = fx (d1 - d) / d1``; not of unit length.
    """
    u, v = ray_slopes(intrinsics, (depth.shape[-2], depth.shape[-1]))
    u, v = u[..., ::stride], v[..., ::stride, :]
    depth = depth[:, ::stride, ::stride]
    fx, fy = intrinsics[:, 0, 0, None, None] / stride, intrinsics[:, 1, 1, None, None] / stride
    x = fx * depth.diff(dim=2) / torch.stack((depth[..., 1:], depth[..., :-1]))  # [2, V, h, w - 1]
    y = fy * depth.diff(dim=1) / torch.stack((depth[:, 1:], depth[:, :-1]))  # [2, V, h - 1, w]
    x, y = torch.stack((x[:, :, :-1], x[:, :, 1:]), 1), torch.stack((y[..., :-1], y[..., 1:]))
    z = -1 - _at_corners(u, -1)[:, None] * x - _at_corners(v, -2) * y
    return torch.stack((x, y, z), 3)


def _turn(cameras: Cameras, truth: Truth) -> Tensor:
    """Rotations ``[V, 3, 3]`` from the true cameras' frames into the predicted ones'."""
    return cameras.world_to_camera[0, :, :3, :3] @ truth.cameras.world_to_camera[0, :, :3, :3].transpose(-1, -2)
