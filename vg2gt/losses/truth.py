"""Ground truth as the losses see it, in the frame of context view 0 and the scene's own unit, and scales to it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from vg2gt.geometry.alignment import fit_depth_scale
from vg2gt.geometry.cameras import relative_to_first, scale_translations
from vg2gt.geometry.normals import ray_slopes
from vg2gt.types import Batch, Cameras, Geometry, TensorRecord

MIN_PIXELS = 100


@dataclass(frozen=True)
class Truth(TensorRecord):
    """Ground truth of all views of B scenes, divided by the scene's mean distance ``a`` from the first camera.

    Attributes:
        depth: ``[B, V, H, W]`` z-depth in units of ``a``; 1 where invalid, so that nothing has to divide by 0.
        valid: ``[B, V, H, W]`` bool.
        cameras: in the frame of view 0, translations in units of ``a``.
        unit: ``[B]`` the divisor ``a``, 1 where the depth is unknown.
        known: ``[B]`` bool, whether the context views have at least 100 valid pixels.
    """

    depth: Tensor
    valid: Tensor
    cameras: Cameras
    unit: Tensor
    known: Tensor

    def views(self, views: slice | Tensor) -> Truth:
        """Returns the truth of some views."""
        return Truth(self.depth[:, views], self.valid[:, views], self.cameras.select(views), self.unit, self.known)

    def scene(self, index: int) -> Truth:
        """Returns the truth of one scene (B = 1)."""
        rows = slice(index, index + 1)
        return Truth(self.depth[rows], self.valid[rows], self.cameras.scene(index), self.unit[rows], self.known[rows])


def normalize_truth(batch: Batch) -> Truth:
    """Brings a batch's depth and cameras into the losses' frame and unit.

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
    """Distance ``[B, V, H, W]`` of every pixel's point from the world origin, which lies at t in the camera frame."""
    u, v = ray_slopes(cameras.intrinsics, (depth.shape[-2], depth.shape[-1]))
    x, y, z = (cameras.world_to_camera[..., i, 3, None, None] for i in range(3))
    return ((depth * u - x).square() + (depth * v - y).square() + (depth - z).square()).sqrt()


SCALE_SOURCES = ("initial", "enhanced", "rendered")


@dataclass(frozen=True)
class ScaleAlignment:
    """How the prediction is brought into the ground truth's unit before the losses compare them.

    Args:
        source: ``initial`` fits the scale on the backbone's own depth, so that no loss is blind to a change of the
            enhanced depth's scale; ``enhanced`` on the enhanced depth; ``rendered`` on the rendered depth, as the
            paper's appendix says, which holes and early training make unstable.

    Raises:
        ValueError: if ``source`` is not one of these.
    """

    source: str = "enhanced"

    def __post_init__(self) -> None:
        if self.source not in SCALE_SOURCES:
            raise ValueError(f"loss.align.source must be one of {SCALE_SOURCES}, got {self.source!r}")

    def fit(self, geometry: Geometry, truth: Truth) -> Tensor:
        """Scales ``[B]`` fitted on the context views' decoded depth; 1 in scenes without known depth."""
        shown = truth.views(slice(0, geometry.depth.shape[1]))
        return _fit(geometry.depth, shown, shown.valid, torch.ones_like(truth.unit))

    def fit_rendered(self, depth: Tensor, hits: Tensor, views: Tensor, truth: Truth, decoded: Tensor) -> Tensor:
        """Scales ``[B]`` fitted on rendered depth if that is the source, else those of the decoded depth.

        Args:
            depth: ``[B, R, H, W]`` rendered depth.
            hits: ``[B, R, H, W]`` bool, where it shows a surface.
            views: ``[R]`` which views of the batch these are.
            truth: ground truth of all views.
            decoded: ``[B]`` scales of the decoded depth, kept for scenes where nothing was rendered.
        """
        if self.source != "rendered":
            return decoded
        shown = truth.views(views)
        return _fit(depth, shown, shown.valid & hits, decoded)


def to_unit(geometry: Geometry, scale: Tensor) -> Geometry:
    """Geometry in another unit, ``scale`` ``[B]`` of which are one of its own."""
    cameras = scale_translations(geometry.cameras, scale)
    return replace(geometry, depth=geometry.depth * scale[:, None, None, None], cameras=cameras)


def _fit(depth: Tensor, shown: Truth, valid: Tensor, fallback: Tensor) -> Tensor:
    scale = fit_depth_scale(depth, shown.depth, valid & shown.known[:, None, None, None])
    return torch.where(scale.isfinite(), scale, fallback)
