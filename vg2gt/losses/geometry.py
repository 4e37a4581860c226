"""VGGT's training losses for depth and point map (paper, Training).

Both are computed in the frames of the predicted cameras, where the ground truth is transformed without gradient.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from vg2gt.geometry.cameras import invert_rigid
from vg2gt.geometry.normals import ray_slopes
from vg2gt.kernels.point_normals import PointNormals
from vg2gt.losses.truth import Truth
from vg2gt.types import Cameras

MAX_ERROR = 100.0
SMALLEST_SQUARE = 1e-20  # keeps the square root's derivative finite
QUANTILE_PIXELS = 1000
DEPTH_STRIDES, POINT_STRIDES = (1, 2, 4, 8), (1, 2, 4)


@dataclass(frozen=True)
class TaskLoss:
    """One task's confidence-weighted error, plain error and error of neighbour differences: scalars with gradient."""

    conf: Tensor
    reg: Tensor
    grad: Tensor

    @property
    def total(self) -> Tensor:
        """``conf + reg + grad``."""
        return self.conf + self.reg + self.grad


@dataclass(frozen=True)
class GeometryLoss:
    """Depth and point-map losses of one scene.

    For the error ``l = |y_hat - y|`` (not squared) and confidence c: ``conf = mean_q(gamma c l - alpha log c)`` and
    ``reg = mean_q(l)``, with values clamped to 100. Both are over the pixels whose l is at or below its ``quantile``.
    ``grad`` compares neighbours at several strides. Scenes with fewer than 100 valid pixels give a zero with gradient.

    Args:
        depth: weight of the depth task.
        point: weight of the point-map task.
        gamma: weight of the confidence-weighted error.
        alpha: weight of the log-confidence.
        quantile: share of pixels kept, > 0 and <= 1; all of them if there are at most 1000.

    Raises:
        ValueError: if ``quantile`` is out of range.
    """

    depth: float = 1.0
    point: float = 1.0
    gamma: float = 1.0
    alpha: float = 0.2
    quantile: float = 0.98

    def __post_init__(self) -> None:
        if not 0 < self.quantile <= 1:
            raise ValueError(
                f"loss.geometry.quantile={self.quantile} must be greater than 0 and at most 1; 1 keeps all pixels"
            )

    def __call__(
        self, depth: Tensor, depth_conf: Tensor, cameras: Cameras, truth: Truth, valid: Tensor
    ) -> tuple[TaskLoss, TaskLoss]:
        """Returns the losses of the depth task and the point-map task for one scene.

        Args:
            depth: ``[1, V, H, W]`` predicted depth in the truth's unit.
            depth_conf: ``[1, V, H, W]`` its confidence > 0.
            cameras: predicted cameras in the frame of view 0, translations in the truth's unit.
            truth: ground truth of the same scene and views.
            valid: ``[1, V, H, W]`` bool, the pixels to compare.
        """
        valid = valid & truth.known[:, None, None, None]
        # replace the prediction by the truth at invalid pixels, so that no infinity or hole reaches the gradients
        depth = torch.where(valid, depth, truth.depth)[0]
        conf = torch.where(valid, depth_conf, 1.0)[0]
        reference, mask = truth.depth[0], valid[0]
        error = depth - reference
        depth_task = TaskLoss(*self._value_terms(error.abs(), conf, mask), depth_gradient_loss(error, mask))
        point_task = TaskLoss(
            *self._value_terms(point_errors(depth, cameras, truth), conf, mask),
            point_normal_loss(depth, cameras, truth, mask),
        )
        return depth_task, point_task

    def _value_terms(self, error: Tensor, conf: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        keep = trusted_pixels(error, valid, self.quantile)
        count = keep.sum().clamp(min=1)
        weighted = (self.gamma * conf * error - self.alpha * conf.log()).clamp(max=MAX_ERROR)
        return (weighted * keep).sum() / count, (error.clamp(max=MAX_ERROR) * keep).sum() / count


def trusted_pixels(error: Tensor, valid: Tensor, quantile: float) -> Tensor:
    """Marks valid pixels whose error, clamped to 100, is at or below its quantile; all if there are at most 1000."""
    clamped = error.detach().clamp(max=MAX_ERROR)
    candidates = torch.where(valid, clamped, torch.inf).flatten()
    count = valid.sum()
    statistic = order_statistic if error.device.type == "cpu" else sorted_order_statistic
    return valid & ((clamped <= statistic(candidates, count, quantile)) | (count <= QUANTILE_PIXELS))


def order_statistic(values: Tensor, count: Tensor, quantile: float) -> Tensor:
    """Returns the quantile of the ``count`` smallest of ``values [N]``, without interpolation, for any N."""
    return values.kthvalue(math.floor(quantile * max(int(count) - 1, 0)) + 1).values


def sorted_order_statistic(values: Tensor, count: Tensor, quantile: float) -> Tensor:
    """:func:`order_statistic` for GPUs, where sorting is many times faster than ``kthvalue``; never synchronises."""
    rank = (quantile * (count - 1).clamp(min=0).double()).floor().long()
    return values.sort().values.gather(0, rank[None])[0]


def depth_gradient_loss(error: Tensor, valid: Tensor) -> Tensor:
    """Sums differences of the depth error ``[V, H, W]`` between valid neighbours per valid pixel; averages strides."""
    total = error.new_zeros(())
    for stride in DEPTH_STRIDES:
        e, m = error[:, ::stride, ::stride], valid[:, ::stride, ::stride]
        across = (e[..., 1:] - e[..., :-1]).abs().clamp(max=MAX_ERROR) * (m[..., 1:] & m[..., :-1])
        down = (e[:, 1:] - e[:, :-1]).abs().clamp(max=MAX_ERROR) * (m[:, 1:] & m[:, :-1])
        total = total + (across.sum() + down.sum()) / m.sum().clamp(min=1)
    return total / len(DEPTH_STRIDES)


def point_errors(depth: Tensor, cameras: Cameras, truth: Truth) -> Tensor:
    """Returns the distance ``[V, H, W]`` between predicted and true points, in each predicted camera's frame.

    Args:
        depth: ``[V, H, W]`` predicted depth, in the truth's unit.
        cameras: predicted cameras (B = 1), translations in the truth's unit.
        truth: ground truth of one scene.
    """
    size = (depth.shape[-2], depth.shape[-1])
    to_predicted = (cameras.world_to_camera @ invert_rigid(truth.cameras.world_to_camera))[0]
    u, v = ray_slopes(truth.cameras.intrinsics[0], size)
    local = torch.stack((truth.depth[0] * u, truth.depth[0] * v, truth.depth[0]), 1).flatten(2)
    true_points = (to_predicted[:, :3, :3] @ local + to_predicted[:, :3, 3:]).unflatten(-1, size)
    u, v = ray_slopes(cameras.intrinsics[0], size)
    x, y, z = true_points.unbind(1)
    squared = (depth * u - x).square() + (depth * v - y).square() + (depth - z).square()
    return squared.clamp(min=SMALLEST_SQUARE).sqrt()


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
