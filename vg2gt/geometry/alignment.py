"""Alignment of predictions to a reference: one scale from depth, one similarity from cameras or points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from torch import Tensor

from vg2gt.geometry.cameras import camera_centers, compose
from vg2gt.geometry.rotations import matrix_to_quat, multiply_quats
from vg2gt.geometry.spherical_harmonics import rotation_of_coefficients
from vg2gt.types import Cameras, Gaussians, TensorRecord

_SUBSAMPLE = 64
MIN_DEPTH = 0.01


def weighted_median(values: Tensor, weights: Tensor) -> Tensor:
    """Returns the lower weighted median along the last axis.

    Args:
        values: ``[..., N]``; entries of weight 0 may be anything.
        weights: ``[..., N]`` >= 0.

    Returns:
        ``[...]``: the smallest value with at least half of the weight at or below it, a minimiser of
        ``sum w |m - x|``; NaN where all weights are 0.
    """
    ordered, order = torch.where(weights > 0, values, torch.inf).sort(-1)
    cumulative = torch.gather(weights, -1, order).double().cumsum(-1)
    total = cumulative[..., -1:]
    index = (cumulative < 0.5 * total).sum(-1, keepdim=True)
    return torch.where(total > 0, torch.gather(ordered, -1, index), torch.nan)[..., 0]


def fit_depth_scale(predicted: Tensor, reference: Tensor, valid: Tensor) -> Tensor:
    """Fits ``argmin_s sum w |s d_hat - d|`` with ``w = 1 / max(d, 0.01)`` for each scene (paper, appendix, wmed).

    The exact solution is the median of ``d / d_hat`` with weights ``w d_hat``. It uses at most 64 x 64 pixels per view:
    in each cell of a grid, the valid pixel nearest to its centre.

    Args:
        predicted: ``[B, V, H, W]`` depth in its own unit.
        reference: ``[B, V, H, W]`` depth in the target unit.
        valid: ``[B, V, H, W]`` bool; pixels where either depth is not finite and positive are also left out.

    Returns:
        ``[B]``, detached; NaN where no pixel is valid.
    """
    predicted, reference = predicted.detach(), reference.detach()
    valid = valid & (predicted > 0) & (reference > 0) & predicted.isfinite() & reference.isfinite()
    pixels = _nearest_valid_pixels(valid)
    predicted, reference, valid = (torch.gather(x.flatten(2), 2, pixels) for x in (predicted, reference, valid))
    weights = torch.where(valid, predicted / reference.clamp(min=MIN_DEPTH), 0.0)
    ratios = reference / torch.where(valid, predicted, 1.0)
    return weighted_median(ratios.flatten(1), weights.flatten(1))


def _nearest_valid_pixels(valid: Tensor) -> Tensor:
    """Returns flat indices ``[B, V, cells]`` of the valid pixel nearest to each cell's centre; any if none is valid."""
    table = _cell_pixels(valid.shape[-2], valid.shape[-1], valid.device)
    first = valid.flatten(2)[:, :, table].to(torch.uint8).argmax(-1, keepdim=True)
    return torch.gather(table.expand(*valid.shape[:2], -1, -1), 3, first)[..., 0]


@lru_cache(maxsize=8)
def _cell_pixels(height: int, width: int, device: torch.device) -> Tensor:
    """Returns the pixels of every cell, nearest to its centre first: ``[cells, most pixels in a cell]``, padded."""
    rows, columns = min(height, _SUBSAMPLE), min(width, _SUBSAMPLE)
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    row, column = y * rows // height, x * columns // width
    cell = (row * columns + column).flatten()
    off_y = (y + 0.5) / height * rows - row - 0.5
    off_x = (x + 0.5) / width * columns - column - 0.5
    distance = ((off_y * height / rows) ** 2 + (off_x * width / columns) ** 2).flatten()
    nearest_first = distance.argsort(stable=True)
    order = nearest_first[cell[nearest_first].argsort(stable=True)]
    count = torch.bincount(cell, minlength=rows * columns)
    start = count.cumsum(0) - count
    slot = torch.minimum(torch.arange(int(count.max())), count[:, None] - 1)
    return order[start[:, None] + slot].to(device)


@dataclass(frozen=True)
class Similarity(TensorRecord):
    """Similarities ``x -> scale * rotation @ x + translation`` of B scenes, ``[B]``, ``[B, 3, 3]`` and ``[B, 3]``."""

    scale: Tensor
    rotation: Tensor
    translation: Tensor

    def apply(self, points: Tensor) -> Tensor:
        """Maps points ``[B, ..., 3]``."""
        flat = compose(points.reshape(points.shape[0], -1, 3), self.rotation.transpose(-1, -2))
        return (self.scale[:, None, None] * flat + self.translation[:, None]).reshape(points.shape)

    def apply_cameras(self, cameras: Cameras) -> Cameras:
        """Moves cameras to the target frame: transforms centres, rotates orientations, keeps intrinsics."""
        rotation = compose(cameras.world_to_camera[..., :3, :3], self.rotation[:, None].transpose(-1, -2))
        translation = -compose(rotation, self.apply(camera_centers(cameras))[..., None])
        top = torch.cat((rotation, translation), -1)
        pose = torch.cat((top, cameras.world_to_camera[..., 3:, :]), -2)
        return Cameras(pose, cameras.intrinsics, cameras.size)

    def apply_gaussians(self, gaussians: Gaussians) -> Gaussians:
        """Moves the Gaussians of one scene (B = 1), computed in float64."""
        move, dtype = self.to(gaussians.means.device).map(Tensor.double), gaussians.means.dtype
        degree = round(gaussians.sh.shape[1] ** 0.5) - 1
        return replace(
            gaussians,
            means=move.apply(gaussians.means[None].double())[0].to(dtype),
            quats=multiply_quats(matrix_to_quat(move.rotation), gaussians.quats.double()).to(dtype),
            scales=(gaussians.scales.double() * move.scale).to(dtype),
            sh=(rotation_of_coefficients(move.rotation[0], degree) @ gaussians.sh.double()).to(dtype),
        )


def align_cameras(
    predicted: Cameras, reference: Cameras, still_scale: Callable[[], Tensor] | None = None
) -> Similarity:
    """Returns the similarity that maps predicted cameras to reference cameras of the same views.

    The rotation is the mean of the cameras' relative orientations (orthogonal Procrustes), since centres on a line do
    not determine it. Given the rotation, scale and translation are Umeyama's solution for the centres.

    Args:
        predicted: B scenes, V views.
        reference: the same views in another frame and unit.
        still_scale: returns the ``[B]`` scale for scenes whose cameras do not determine it, for example because they do
            not move in one of the frames; only called if there is such a scene. None means 1.

    Returns:
        ``[B]`` similarities from the predicted to the reference frame, computed in float64, in the input's dtype.
    """
    dtype = predicted.world_to_camera.dtype
    own, given = (cameras.world_to_camera[..., :3, :3].double() for cameras in (predicted, reference))
    rotation = _nearest_rotation((given.transpose(-1, -2) @ own).sum(1))
    source, target = camera_centers(predicted).double(), camera_centers(reference).double()
    moves = _moves(source) & _moves(target)
    return _umeyama(rotation, source, target, moves, still_scale).map(lambda tensor: tensor.to(dtype))


def align_points(points: Tensor, reference: Tensor) -> Similarity:
    """Returns the least-squares similarity between corresponding points (Umeyama 1991).

    Args:
        points: ``[B, N, 3]``.
        reference: ``[B, N, 3]``, the same points in another frame and unit.

    Returns:
        ``[B]`` similarities from the points' frame to the reference's, computed in float64, in the input's dtype. The
        scale is 1 if all points coincide.
    """
    source, target = points.double(), reference.double()
    centered, centered_target = source - source.mean(1)[:, None], target - target.mean(1)[:, None]
    rotation = _nearest_rotation(centered_target.transpose(-1, -2) @ centered)
    return _umeyama(rotation, source, target, _moves(source), None).map(lambda tensor: tensor.to(points.dtype))


def _umeyama(
    rotation: Tensor, source: Tensor, target: Tensor, moves: Tensor, still_scale: Callable[[], Tensor] | None
) -> Similarity:
    """Adds the least-squares scale (or ``still_scale()``) and translation to a rotation (Umeyama 1991, eqn 41, 42)."""
    source_mean, target_mean = source.mean(1), target.mean(1)
    turned = (source - source_mean[:, None]) @ rotation.transpose(-1, -2)
    agreement = (turned * (target - target_mean[:, None])).sum((1, 2))
    told = moves & (agreement > 0)
    still = 1.0 if still_scale is None or bool(told.all()) else still_scale().double()
    scale = torch.where(told, agreement / turned.square().sum((1, 2)), still)
    translation = target_mean - scale[:, None] * (rotation @ source_mean[..., None])[..., 0]
    return Similarity(scale, rotation, translation)


def _moves(centers: Tensor) -> Tensor:
    """Returns ``[B]`` bool: whether the points ``[B, N, 3]`` of a scene differ by more than float32 rounding."""
    spread = (centers - centers.mean(1, keepdim=True)).norm(dim=-1).amax(1)
    return spread > 1e-6 * centers.norm(dim=-1).amax(1)


def _nearest_rotation(matrix: Tensor) -> Tensor:
    """Returns the rotation R that maximises ``trace(R^T M)`` for each M ``[B, 3, 3]``; NaN where M is not finite."""
    finite = matrix.isfinite().all(-1).all(-1)[:, None, None]
    u, _, vh = torch.linalg.svd(torch.where(finite, matrix, 0.0))  # raises on input that is not finite
    sign = torch.ones_like(matrix[:, 0])
    sign[:, 2] = torch.linalg.det(u @ vh).sign()
    return torch.where(finite, (u * sign[:, None]) @ vh, torch.nan)
