"""One constant scale a scene brings the prediction into the ground truth's unit (paper, appendix, Model Training)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from vg2gt.geometry.alignment import fit_depth_scale
from vg2gt.geometry.cameras import scale_translations
from vg2gt.losses.truth import Truth
from vg2gt.types import Geometry

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
