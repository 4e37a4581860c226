"""Ground truth for the losses, in the frame of context view 0 and a unit per scene, and the scales to that unit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from vg2gt.geometry.alignment import fit_depth_scale
from vg2gt.geometry.cameras import relative_to_first, scale_translations
from vg2gt.geometry.normals import ray_slopes
from vg2gt.types import Batch, Cameras, Geometry, TensorRecord, check_choice

MIN_PIXELS = 100


@dataclass(frozen=True)
class Truth(TensorRecord):
    """Ground truth of all views of B scenes, divided by the scene's mean distance ``a`` from the first camera.

    Attributes:
        depth: ``[B, V, H, W]`` z-depth in units of ``a``; 1 where invalid, to avoid division by 0.
        valid: ``[B, V, H, W]`` bool.
        cameras: in the frame of view 0, translations in units of ``a``.
        unit: ``[B]`` the divisor ``a``, 1 where the depth is unknown.
        known: ``[B]`` bool, whether the context views have at least 100 valid pixels together.
    """

    depth: Tensor
    valid: Tensor
    cameras: Cameras
    unit: Tensor
    known: Tensor

    def views(self, views: slice | Tensor) -> Truth:
        """Returns the truth of some views."""
        return Truth(self.depth[:, views], self.valid[:, views], self.cameras.select(views), self.unit, self.known)


def normalize_truth(batch: Batch) -> Truth:
    """Converts a batch's depth and cameras to the losses' frame and unit.

    ``a = clamp(sum M |X| / (sum M + 1e-3), 1e-6, 1e6)`` over the context views, X in the frame of view 0 (VGGT).
    """
    cameras = relative_to_first(batch.cameras)
    valid = (batch.depth > 0) & batch.depth.isfinite()
    depth = torch.where(valid, batch.depth, 1.0)
    context = slice(0, batch.num_context)
    distance = _distance_from_first(depth[:, context], cameras.select(context))
    mask = valid[:, context]
    count = mask.sum((1, 2, 3))
    unit = ((distance * mask).sum((1, 2, 3)) / (count + 1e-3)).clamp(1e-6, 1e6)
    known = count >= MIN_PIXELS
    unit = torch.where(known, unit, 1.0)
    depth = torch.where(valid, depth / unit[:, None, None, None], 1.0)
    return Truth(depth, valid, scale_translations(cameras, 1 / unit), unit, known)


def _distance_from_first(depth: Tensor, cameras: Cameras) -> Tensor:
    """Returns the distance ``[B, V, H, W]`` of every pixel's point from the world origin, t in the camera frame."""
    u, v = ray_slopes(cameras.intrinsics, (depth.shape[-2], depth.shape[-1]))
    x, y, z = (cameras.world_to_camera[..., i, 3, None, None] for i in range(3))
    return ((depth * u - x).square() + (depth * v - y).square() + (depth - z).square()).sqrt()


@dataclass(frozen=True)
class ScaleAlignment:
    """Fits the scale that converts a prediction to the ground truth's unit before the losses compare them.

    Args:
        source: ``initial`` fits the backbone's own depth, so that losses notice a change of the enhanced depth's scale;
            ``enhanced`` fits the enhanced depth; ``rendered`` fits the rendered depth as in the paper's appendix, which
            is unstable with holes and early in training.

    Raises:
        ValueError: if ``source`` is not one of these.
    """

    source: str = "enhanced"

    def __post_init__(self) -> None:
        check_choice("loss.align.source", self.source, ("initial", "enhanced", "rendered"))


def fit_scale(depth: Tensor, truth: Truth, valid: Tensor, fallback: Tensor | float = 1.0) -> Tensor:
    """Fits scales ``[B]`` from decoded or rendered depth to the truth's unit.

    Args:
        depth: ``[B, V, H, W]``.
        truth: ground truth of the same views.
        valid: ``[B, V, H, W]`` bool, the pixels to fit.
        fallback: ``[B]`` scales of scenes without known depth or pixels to fit.
    """
    scale = fit_depth_scale(depth, truth.depth, valid & truth.known[:, None, None, None])
    return torch.where(scale.isfinite(), scale, fallback)


def to_unit(geometry: Geometry, scale: Tensor) -> Geometry:
    """Converts geometry to another unit, with ``scale`` ``[B]`` new units per old unit."""
    cameras = scale_translations(geometry.cameras, scale)
    return replace(geometry, depth=geometry.depth * scale[:, None, None, None], cameras=cameras)
