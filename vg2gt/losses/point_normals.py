"""Normal loss of the point-map task (VGGT's point-gradient loss; paper, Training): plain, and compiled for CPUs."""

from __future__ import annotations

import torch
from torch import Tensor

from vg2gt.geometry.normals import ray_slopes
from vg2gt.kernels.point_normals import PointNormals
from vg2gt.losses.truth import Truth
from vg2gt.types import Cameras

POINT_STRIDES = (1, 2, 4)


def point_normal_loss(depth: Tensor, cameras: Cameras, truth: Truth, valid: Tensor) -> Tensor:
    """Returns ``mean(1 - cos)`` between predicted and true surface normals, averaged over strides.

    Each pixel has four normals, one for each pair of a horizontal and a vertical neighbour (VGGT's cross products of
    point-map differences). A normal counts if the pixel and both neighbours are valid.

    Args:
        depth: ``[V, H, W]`` predicted depth, in the truth's unit.
        cameras: predicted cameras (B = 1). If they require a gradient, or depth is not on a CPU, plain torch is used.
        truth: ground truth of one scene.
        valid: ``[V, H, W]`` bool.
    """
    fixed = not (cameras.world_to_camera.requires_grad or cameras.intrinsics.requires_grad)
    if fixed and depth.device.type == "cpu" and depth.dtype in (torch.float32, torch.float64):
        intrinsics = (cameras.intrinsics[0], truth.cameras.intrinsics[0])
        return PointNormals.apply(depth, truth.depth[0], valid, *intrinsics, _turn(cameras, truth), POINT_STRIDES)
    return point_normal_reference(depth, cameras, truth, valid)


def point_normal_reference(depth: Tensor, cameras: Cameras, truth: Truth, valid: Tensor) -> Tensor:
    """:func:`point_normal_loss` in plain torch, for any device; also differentiable in the cameras."""
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
    """Stacks the values at positions i and i + 1 along ``dim``: ``[2, ...]``."""
    count = between.shape[dim] - 1
    return torch.stack((between.narrow(dim, 0, count), between.narrow(dim, 1, count)))


def _corner_normals(depth: Tensor, intrinsics: Tensor, stride: int) -> Tensor:
    """Returns camera-frame normals ``[2, 2, V, 3, h - 1, w - 1]`` at the corners of 2x2 squares of the strided depth.

    The first two axes select the corner whose neighbours are to the right or left, and below or above. Computed as in
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
    """Returns rotations ``[V, 3, 3]`` from the true cameras' frames to the predicted ones'."""
    return cameras.world_to_camera[0, :, :3, :3] @ truth.cameras.world_to_camera[0, :, :3, :3].transpose(-1, -2)
