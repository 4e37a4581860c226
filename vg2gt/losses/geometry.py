"""VGGT's training losses for depth and point map (paper, Training).

Both are computed in the frames of the predicted cameras, where the ground truth is transformed without gradient.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from vg2gt.geometry.cameras import invert_rigid
from vg2gt.geometry.normals import ray_slopes
from vg2gt.kernels.point_normals import PointNormals
from vg2gt.losses.strided import Neighbors, neighbor_pairs, pixel_squares
from vg2gt.losses.truth import Truth
from vg2gt.types import Cameras

_MAX_ERROR = 100.0
_SMALLEST_SQUARE = 1e-20  # keeps the square root's derivative finite
_QUANTILE_PIXELS = 1000
_DEPTH_STRIDES, _POINT_STRIDES = (1, 2, 4, 8), (1, 2, 4)
MAPS = (-3, -2, -1)  # views, rows and columns


@dataclass(frozen=True)
class TaskLoss:
    """One task's confidence-weighted error, plain error and error of neighbour differences: ``[..., B]``."""

    conf: Tensor
    reg: Tensor
    grad: Tensor

    @cached_property
    def total(self) -> Tensor:
        """``conf + reg + grad``."""
        return self.conf + self.reg + self.grad

    def __getitem__(self, index: int) -> TaskLoss:
        """Returns the losses at an index of the first axis."""
        return TaskLoss(self.conf[index], self.reg[index], self.grad[index])


@dataclass(frozen=True)
class GeometryLoss:
    """Depth and point-map losses of every scene.

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
        """Returns the losses of the depth task and the point-map task of every scene.

        Axes before that of the scenes hold several predictions of the same truth.

        Args:
            depth: ``[..., B, V, H, W]`` predicted depth in the truth's unit.
            depth_conf: ``[..., B, V, H, W]`` its confidence > 0.
            cameras: predicted cameras ``[..., B, V]`` in the frame of view 0, translations in the truth's unit.
            truth: ground truth of the same scenes and views.
            valid: ``[B, V, H, W]`` bool, the pixels to compare.
        """
        valid = valid & truth.known[:, None, None, None]
        # replace the prediction by the truth at invalid pixels, so that no infinity or hole reaches the gradients
        depth = torch.where(valid, depth, truth.depth)
        error = depth - truth.depth
        errors = torch.stack((error.abs(), point_errors(depth, cameras, truth)))  # of both tasks
        conf, reg = self._value_terms(errors, torch.where(valid, depth_conf, 1.0), valid)
        return (
            TaskLoss(conf[0], reg[0], depth_gradient_loss(error, valid)),
            TaskLoss(conf[1], reg[1], point_normal_loss(depth, cameras, truth, valid)),
        )

    def _value_terms(self, error: Tensor, conf: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        keep = trusted_pixels(error, valid, self.quantile)
        count = keep.sum(MAPS).clamp(min=1)
        weighted = (self.gamma * conf * error - self.alpha * conf.log()).clamp(max=_MAX_ERROR)
        return (weighted * keep).sum(MAPS) / count, (error.clamp(max=_MAX_ERROR) * keep).sum(MAPS) / count


def trusted_pixels(error: Tensor, valid: Tensor, quantile: float) -> Tensor:
    """Marks each scene's pixels whose error, clamped to 100, is at or below its quantile; all if at most 1000.

    Args:
        error: ``[..., V, H, W]``.
        valid: ``[V, H, W]`` bool with any of the leading axes; other pixels are never marked.
        quantile: share of the pixels.
    """
    clamped = error.detach().clamp(max=_MAX_ERROR)
    candidates = torch.where(valid, clamped, torch.inf).flatten(-3)
    count = valid.sum(MAPS)
    statistic = order_statistic if error.device.type == "cpu" else sorted_order_statistic
    limit = statistic(candidates, count.expand(error.shape[:-3]), quantile)
    return valid & ((clamped <= limit[..., None, None, None]) | (count <= _QUANTILE_PIXELS)[..., None, None, None])


def order_statistic(values: Tensor, count: Tensor, quantile: float) -> Tensor:
    """Returns the quantile of the ``count [...]`` smallest of ``values [..., N]``, without interpolation, for any N."""
    rows = zip(values.flatten(0, -2) if values.dim() > 1 else values[None], count.flatten().tolist(), strict=True)
    found = [row.kthvalue(math.floor(quantile * max(number - 1, 0)) + 1).values for row, number in rows]
    return torch.stack(found).view(count.shape)


def sorted_order_statistic(values: Tensor, count: Tensor, quantile: float) -> Tensor:
    """:func:`order_statistic` for GPUs, where sorting is many times faster than ``kthvalue``; never synchronises."""
    rank = (quantile * (count - 1).clamp(min=0).double()).floor().long()
    return values.sort().values.gather(-1, rank[..., None])[..., 0]


def depth_gradient_loss(error: Tensor, valid: Tensor) -> Tensor:
    """Sums differences of the depth error between valid neighbours per valid pixel; averages strides.

    Args:
        error: ``[..., V, H, W]``.
        valid: ``[V, H, W]`` bool with any of the leading axes.
    """
    pairs = neighbor_pairs((error.shape[-2], error.shape[-1]), _DEPTH_STRIDES, error.device)
    first, second = pairs.read(error).unbind(-2)  # [..., V, N]
    known, also = pairs.read(valid).unbind(-2)
    differences = ((second - first).abs().clamp(max=_MAX_ERROR) * (known & also)).sum(-2)
    counts = [valid[..., ::stride, ::stride].sum(MAPS) for stride in _DEPTH_STRIDES]
    return (pairs.sums(differences) / torch.stack(counts, -1).clamp(min=1)).mean(-1)


def point_errors(depth: Tensor, cameras: Cameras, truth: Truth) -> Tensor:
    """Returns the distance ``[..., B, V, H, W]`` between predicted and true points, in each predicted camera's frame.

    Args:
        depth: ``[..., B, V, H, W]`` predicted depth, in the truth's unit.
        cameras: predicted cameras ``[..., B, V]``, translations in the truth's unit.
        truth: ground truth of the B scenes.
    """
    size = (depth.shape[-2], depth.shape[-1])
    to_predicted = cameras.world_to_camera @ invert_rigid(truth.cameras.world_to_camera)
    u, v = ray_slopes(truth.cameras.intrinsics, size)
    local = torch.stack((truth.depth * u, truth.depth * v, truth.depth), -3).flatten(-2)
    true_points = (to_predicted[..., :3, :3] @ local + to_predicted[..., :3, 3:]).unflatten(-1, size)
    u, v = ray_slopes(cameras.intrinsics, size)
    x, y, z = true_points.unbind(-3)
    squared = (depth * u - x).square() + (depth * v - y).square() + (depth - z).square()
    return squared.clamp(min=_SMALLEST_SQUARE).sqrt()


def point_normal_loss(depth: Tensor, cameras: Cameras, truth: Truth, valid: Tensor) -> Tensor:
    """Returns ``mean(1 - cos)`` ``[..., B]`` between predicted and true surface normals, averaged over strides.

    Each pixel has four normals, one for each pair of a horizontal and a vertical neighbour (VGGT's cross products of
    point-map differences). A normal counts if the pixel and both neighbours are valid.

    Args:
        depth: ``[..., B, V, H, W]`` predicted depth, in the truth's unit.
        cameras: predicted cameras ``[..., B, V]``. If they require a gradient, or depth is not on a CPU, plain torch is
            used.
        truth: ground truth of the B scenes.
        valid: ``[B, V, H, W]`` bool.
    """
    fixed = not (cameras.world_to_camera.requires_grad or cameras.intrinsics.requires_grad)
    if fixed and depth.device.type == "cpu" and depth.dtype in (torch.float32, torch.float64):
        maps = (depth, truth.depth.expand_as(depth), valid.expand_as(depth))
        poses = (cameras.intrinsics, truth.cameras.intrinsics.expand_as(cameras.intrinsics), _turn(cameras, truth))
        scenes = zip(*(part.flatten(0, depth.dim() - 4) for part in (*maps, *poses)), strict=True)
        losses: list[Tensor] = [PointNormals.apply(*scene, _POINT_STRIDES) for scene in scenes]  # pyright: ignore
        return torch.stack(losses).view(depth.shape[:-3])
    return point_normal_reference(depth, cameras, truth, valid)


def point_normal_reference(depth: Tensor, cameras: Cameras, truth: Truth, valid: Tensor) -> Tensor:
    """:func:`point_normal_loss` in plain torch, for any device; also differentiable in the cameras."""
    squares = pixel_squares(cameras.size, _POINT_STRIDES, depth.device)
    predicted = _corner_normals(depth, cameras, squares)  # [..., B, V, 3, 2, 2, N]
    true = _corner_normals(truth.depth, truth.cameras, squares)
    true = (_turn(cameras, truth) @ true.flatten(-3)).view_as(predicted)
    lengths = (predicted.square().sum(-4) * true.square().sum(-4)).sqrt()
    cosine = (predicted * true).sum(-4) / lengths  # [..., B, V, 2, 2, N]
    mask = squares.read(valid).unflatten(-2, (2, 2))
    both = mask.all(-2)[..., None, :] & mask.all(-3)[..., None, :, :]
    corners = (-4, -3, -2)
    sums = squares.sums(((1 - cosine) * both).sum(corners)) / squares.sums(both.sum(corners)).clamp(min=1)
    return sums.mean(-1)


def _corner_normals(depth: Tensor, cameras: Cameras, squares: Neighbors) -> Tensor:
    """Returns camera-frame normals ``[..., 3, 2, 2, N]`` at the corners of squares of depth.

    The axes of length two select the upper or lower corner, and the left or right one. Computed as in
    :mod:`vg2gt.geometry.normals`, with ``gx = fx (d1 - d) / d1``; not of unit length.
    """
    depth = squares.read(depth).unflatten(-2, (2, 2))
    (left, right), (upper, lower) = depth.unbind(-2), depth.unbind(-3)  # [..., 2, N] each
    fx, fy = (cameras.intrinsics[..., i, i, None, None] / squares.stride for i in range(2))
    x = (fx * (right - left))[..., None, :] / depth.flip(-2)
    y = (fy * (lower - upper))[..., None, :, :] / depth.flip(-3)
    slopes = (part.expand(*part.shape[:-2], *cameras.size) for part in ray_slopes(cameras.intrinsics, cameras.size))
    u, v = (squares.read(part).unflatten(-2, (2, 2)) for part in slopes)
    z = -1 - u * x - v * y
    return torch.stack((x, y, z), -4)


def _turn(cameras: Cameras, truth: Truth) -> Tensor:
    """Returns rotations ``[..., B, V, 3, 3]`` from the true cameras' frames to the predicted ones'."""
    return cameras.world_to_camera[..., :3, :3] @ truth.cameras.world_to_camera[..., :3, :3].transpose(-1, -2)
