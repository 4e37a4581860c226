"""One constant scale a scene brings the prediction into the ground truth's unit (paper, appendix, Model Training)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from vg2gt.geometry.alignment import fit_depth_scale
from vg2gt.geometry.cameras import scale_translations
from vg2gt.losses.truth import Truth
from vg2gt.types import Geometry, TensorRecord

SCALE_SOURCES = ("initial", "enhanced", "rendered")


@dataclass(frozen=True)
class Scales(TensorRecord):
    """Ground-truth units of the losses per unit of the prediction, constants.

    Attributes:
        scene: ``[B]``, for translations and held-out views.
        context: ``[B, V]``, for the depth of each context view; the scene's unless fitted per view.
    """

    scene: Tensor
    context: Tensor

    def apply(self, geometry: Geometry) -> Geometry:
        """Brings the context views' geometry into the losses' unit."""
        cameras = scale_translations(geometry.cameras, self.scene)
        return replace(geometry, depth=geometry.depth * self.context[:, :, None, None], cameras=cameras)

    def of_views(self, views: Tensor) -> Tensor:
        """The scale ``[B, R]`` of some of the batch's views, context views being the first."""
        is_context = views < self.context.shape[1]
        return torch.where(is_context, self.context[:, torch.where(is_context, views, 0)], self.scene[:, None])


@dataclass(frozen=True)
class ScaleAlignment:
    """How the prediction is brought into the ground truth's unit before the losses compare them.

    Args:
        source: ``initial`` fits the scale on the backbone's own depth, so that no loss is blind to a change of the
            enhanced depth's scale; ``enhanced`` on the enhanced depth; ``rendered`` on the rendered depth, as the
            paper's appendix says, which holes and early training make unstable.
        per_view: fit every context view's depth on its own; translations and held-out views keep the scene's scale.

    Raises:
        ValueError: if ``source`` is not one of these.
    """

    source: str = "enhanced"
    per_view: bool = False

    def __post_init__(self) -> None:
        if self.source not in SCALE_SOURCES:
            raise ValueError(f"loss.align.source must be one of {SCALE_SOURCES}, got {self.source!r}")

    def fit(self, geometry: Geometry, truth: Truth) -> Scales:
        """Fits the scales on decoded depth; 1 in scenes without known depth."""
        fallback = torch.ones_like(truth.unit)
        context = torch.arange(geometry.depth.shape[1], device=geometry.depth.device)
        start = Scales(fallback, fallback[:, None].expand(-1, len(context)))
        return self._fit(geometry.depth, truth.views(context), context, truth.views(context).valid, start)

    def fit_rendered(self, depth: Tensor, hits: Tensor, views: Tensor, truth: Truth, decoded: Scales) -> Scales:
        """Fits the scales on rendered depth if that is the source, else returns those of the decoded depth.

        Args:
            depth: ``[B, R, H, W]`` rendered depth.
            hits: ``[B, R, H, W]`` bool, where it shows a surface.
            views: ``[R]`` which views of the batch these are.
            truth: ground truth of all views.
            decoded: the decoded depth's scales, kept for scenes where nothing was rendered.
        """
        if self.source != "rendered":
            return decoded
        shown = truth.views(views)
        return self._fit(depth, shown, views, shown.valid & hits, decoded)

    def _fit(self, depth: Tensor, shown: Truth, views: Tensor, valid: Tensor, fallback: Scales) -> Scales:
        valid = valid & shown.known[:, None, None, None]
        scene = fit_depth_scale(depth, shown.depth, valid)
        scene = torch.where(scene.isfinite(), scene, fallback.scene)
        context = scene[:, None].repeat(1, fallback.context.shape[1])
        if self.per_view:
            fitted = fit_depth_scale(depth, shown.depth, valid, per_view=True)
            fitted = torch.where(fitted.isfinite(), fitted, scene[:, None])
            is_context = views < context.shape[1]
            context[:, views[is_context]] = fitted[:, is_context]
        return Scales(scene, context)
