"""The training objective: geometry, enhancement and Gaussian losses with one scale a scene (paper, Training)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from vg2gt.geometry.alignment import fit_depth_scale
from vg2gt.geometry.cameras import scale_translations
from vg2gt.losses.enhancement import EnhancementLoss
from vg2gt.losses.gaussian import GaussianLoss, RenderTargets
from vg2gt.losses.geometry import GeometryLoss, camera_errors
from vg2gt.losses.truth import Truth, normalize_truth
from vg2gt.types import Batch, Cameras, Geometry, Prediction, Render

SCALE_SOURCES = ("enhanced", "rendered")


@dataclass(frozen=True)
class LossReport:
    """What a training step learns from the objective.

    Attributes:
        total: scalar with graph, the mean over scenes of the weighted sum of the terms.
        terms: unweighted terms, means over scenes, scalars without graph. ``initial_depth`` and ``initial_point`` are
            what the enhancement loss compares with; ``camera_*`` are logged only; ``rendered`` is the share of rendered
            pixels that have a depth.
        scale: ``[B]`` ground-truth unit of the losses per scene unit.
        skipped: scenes with fewer than 100 valid depth pixels, whose depth terms are 0.
    """

    total: Tensor
    terms: dict[str, Tensor]
    scale: Tensor
    skipped: int


@dataclass(frozen=True)
class ScaleAlignment:
    """How the prediction is brought into the ground truth's unit before the losses compare them.

    Args:
        source: ``enhanced`` fits the scale on the enhanced depth; ``rendered`` on the rendered depth, as the paper's
            appendix says, which holes and early training make unstable.
        per_view: fit every context view's depth on its own; translations and held-out views keep the scene's scale.

    Raises:
        ValueError: if ``source`` is not one of these.
    """

    source: str = "enhanced"
    per_view: bool = False

    def __post_init__(self) -> None:
        if self.source not in SCALE_SOURCES:
            raise ValueError(f"loss.align.source must be one of {SCALE_SOURCES}, got {self.source!r}")


class VG2GTLoss(nn.Module):
    """The objective of VG²GT.

    Per scene: depth and point-map losses of the enhanced geometry, the hinge against the backbone's own, and the
    losses of the rendered views; scenes count alike. Ground truth is divided by the scene's mean distance from the
    first camera; one constant scale a scene brings depth, translations, points and rendered depth into that unit.

    Args:
        geometry: depth and point-map losses; default as in VGGT.
        enhance: enhancement hinge; default the improving form.
        gaussian: losses of rendered views; default the paper's weights.
        align: scale fit.
    """

    def __init__(
        self,
        geometry: GeometryLoss | None = None,
        enhance: EnhancementLoss | None = None,
        gaussian: GaussianLoss | None = None,
        align: ScaleAlignment | None = None,
    ) -> None:
        super().__init__()
        self.geometry = geometry or GeometryLoss()
        self.enhance = enhance or EnhancementLoss()
        self.gaussian = gaussian or GaussianLoss()
        self.align = align or ScaleAlignment()

    def forward(
        self,
        prediction: Prediction,
        batch: Batch,
        rendered: Render | None = None,
        views: Tensor | None = None,
        render_cameras: Cameras | None = None,
    ) -> LossReport:
        """Computes the objective in float32 (float64 stays float64), whatever the autocast.

        Args:
            prediction: geometry of the context views, in the frame of context view 0 and in scene units.
            batch: ground truth of context and held-out views.
            rendered: renders of some views of the batch, or None for the geometry losses only.
            views: ``[R]`` int64, which of the batch's views were rendered; indices below ``num_context`` are context
                views, the others have no decoded depth to be compared with.
            render_cameras: the R cameras used for rendering.

        Raises:
            ValueError: if the geometry does not cover the context views, or renders, views and cameras do not go
                together.
        """
        _check(prediction, batch, rendered, views, render_cameras)
        with torch.autocast(batch.images.device.type, enabled=False):
            truth = normalize_truth(batch.map(_full_precision))
            initial, enhanced = (g.map(_full_precision) for g in (prediction.initial, prediction.geometry))
            scenes: list[tuple[Tensor, dict[str, Tensor]]]
            if rendered is None or views is None or render_cameras is None:
                scale, view_scale = self._fit(enhanced, truth, None, None)
                scenes = self._geometry(initial, enhanced, truth, batch.num_context, scale, view_scale)
            else:
                views = views.to(batch.images.device)
                rendered, render_cameras = rendered.map(_full_precision), render_cameras.map(_full_precision)
                scale, view_scale = self._fit(enhanced, truth, rendered, views)
                scenes = self._geometry(initial, enhanced, truth, batch.num_context, scale, view_scale)
                targets, render_scale = _render_targets(batch, enhanced, truth, views, scale, view_scale)
                scenes = [
                    self._add_gaussian(scene, index, rendered, render_cameras, targets, render_scale)
                    for index, scene in enumerate(scenes)
                ]
            total = torch.stack([scene[0] for scene in scenes]).mean()
            terms = {name: torch.stack([t[name].detach() for _, t in scenes]).mean() for name in scenes[0][1]}
        return LossReport(total, terms, scale, int((~truth.known).sum()))

    def _fit(
        self, geometry: Geometry, truth: Truth, rendered: Render | None, views: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """The scale of each scene ``[B]`` and of each context view ``[B, V]``."""
        scale, view_scale = self._fit_geometry(geometry, truth)
        if self.align.source == "rendered" and rendered is not None and views is not None:
            shown = truth.views(views)
            valid = shown.valid & self.gaussian.hits(rendered)
            fitted = fit_depth_scale(rendered.depth, shown.depth, valid)
            fitted = torch.where(truth.known & fitted.isfinite(), fitted, scale)
            if self.align.per_view:
                fits = fit_depth_scale(rendered.depth, shown.depth, valid, per_view=True)
                fits = torch.where(truth.known[:, None] & fits.isfinite(), fits, fitted[:, None])
                view_scale = fitted[:, None].repeat(1, view_scale.shape[1])
                is_context = views < view_scale.shape[1]
                view_scale[:, views[is_context]] = fits[:, is_context]
            else:
                view_scale = fitted[:, None].expand_as(view_scale)
            scale = fitted
        return scale, view_scale

    def _fit_geometry(self, geometry: Geometry, truth: Truth) -> tuple[Tensor, Tensor]:
        context = truth.views(slice(0, geometry.depth.shape[1]))
        scale = fit_depth_scale(geometry.depth, context.depth, context.valid)
        scale = torch.where(truth.known & scale.isfinite(), scale, 1.0)
        if not self.align.per_view:
            return scale, scale[:, None].expand(geometry.depth.shape[:2])
        view_scale = fit_depth_scale(geometry.depth, context.depth, context.valid, per_view=True)
        return scale, torch.where(truth.known[:, None] & view_scale.isfinite(), view_scale, scale[:, None])

    def _geometry(
        self,
        initial: Geometry,
        enhanced: Geometry,
        truth: Truth,
        num_context: int,
        scale: Tensor,
        view_scale: Tensor,
    ) -> list[tuple[Tensor, dict[str, Tensor]]]:
        """Weighted sum and terms of the geometry and enhancement losses of each scene."""
        truth = truth.views(slice(0, num_context))
        valid = truth.valid & (initial.depth > 0) & (enhanced.depth > 0)
        before = _rescale(initial, *self._fit_geometry(initial, truth))
        after = _rescale(enhanced, scale, view_scale)
        scenes = []
        for index in range(valid.shape[0]):
            rows, scene_truth = slice(index, index + 1), truth.scene(index)
            with torch.no_grad():
                depth_before, point_before = self._tasks(before, rows, scene_truth, valid[rows])
            depth_after, point_after = self._tasks(after, rows, scene_truth, valid[rows])
            hinge_depth = self.enhance(depth_before, depth_after)
            hinge_point = self.enhance(point_before, point_after)
            total = self.geometry.depth * depth_after.total + self.geometry.point * point_after.total
            total = total + self.enhance.weight * (hinge_depth + hinge_point)
            terms = {
                f"{task}_{part}": getattr(loss, part)
                for task, loss in (("depth", depth_after), ("point", point_after))
                for part in ("conf", "reg", "grad")
            }
            terms |= {"enhance_depth": hinge_depth, "enhance_point": hinge_point}
            terms["initial_depth"] = self.enhance.compared(depth_before)
            terms["initial_point"] = self.enhance.compared(point_before)
            terms |= camera_errors(after.cameras.scene(index), scene_truth.cameras)
            scenes.append((total, terms))
        return scenes

    def _tasks(self, geometry: Geometry, rows: slice, truth: Truth, valid: Tensor):
        cameras = geometry.cameras.scene(rows.start)
        return self.geometry(geometry.depth[rows], geometry.depth_conf[rows], cameras, truth, valid)

    def _add_gaussian(
        self,
        scene: tuple[Tensor, dict[str, Tensor]],
        index: int,
        rendered: Render,
        cameras: Cameras,
        targets: RenderTargets,
        render_scale: Tensor,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Adds the Gaussian losses of one scene to its weighted sum and terms."""
        one = rendered.map(lambda tensor: tensor[index : index + 1])
        terms = self.gaussian(one, cameras.scene(index), targets.map(lambda tensor: tensor[index]), render_scale[index])
        share = self.gaussian.hits(one).to(one.depth.dtype).mean()
        return scene[0] + self.gaussian.total(terms), scene[1] | terms | {"rendered": share}


def _render_targets(
    batch: Batch, geometry: Geometry, truth: Truth, views: Tensor, scale: Tensor, view_scale: Tensor
) -> tuple[RenderTargets, Tensor]:
    """What the rendered views should show, ``[B, R, ...]``, and the scale ``[B, R]`` of each."""
    is_context = views < batch.num_context
    source = torch.where(is_context, views, 0)
    render_scale = torch.where(is_context, view_scale[:, source], scale[:, None])
    decoded = geometry.depth[:, source]
    shown = truth.views(views)
    known = truth.known[:, None, None, None]
    targets = RenderTargets(
        images=_full_precision(batch.images[:, views]),
        depth=shown.depth,
        valid=shown.valid & known,
        intrinsics=shown.cameras.intrinsics,
        decoded=decoded * render_scale[:, :, None, None],
        decoded_conf=geometry.depth_conf[:, source],
        decoded_valid=(decoded > 0) & is_context[:, None, None],
        comparable=known.expand(-1, len(views), 1, 1),
    )
    return targets, render_scale


def _rescale(geometry: Geometry, scale: Tensor, view_scale: Tensor) -> Geometry:
    """Multiplies depth by its view's scale and translations by the scene's."""
    return replace(
        geometry,
        depth=geometry.depth * view_scale[:, :, None, None],
        cameras=scale_translations(geometry.cameras, scale),
    )


def _full_precision(tensor: Tensor) -> Tensor:
    return tensor.float() if tensor.dtype in (torch.float16, torch.bfloat16) else tensor


def _check(
    prediction: Prediction, batch: Batch, rendered: Render | None, views: Tensor | None, cameras: Cameras | None
) -> None:
    size = batch.images.shape[-2:]
    expected = (len(batch.scene), batch.num_context, *size)
    for name, geometry in (("initial", prediction.initial), ("geometry", prediction.geometry)):
        if tuple(geometry.depth.shape) != expected:
            raise ValueError(
                f"prediction.{name}.depth is {tuple(geometry.depth.shape)}, but the batch has context views "
                f"{expected}: pass the prediction made from batch.context"
            )
    if rendered is None:
        return
    if views is None or cameras is None:
        raise ValueError("rendered views need views= (their indices in the batch) and render_cameras=")
    found = (tuple(rendered.color.shape[:2]), tuple(cameras.world_to_camera.shape[:2]))
    if found != ((len(batch.scene), len(views)),) * 2:
        raise ValueError(
            f"views names {len(views)} views of {len(batch.scene)} scenes, but rendered and render_cameras have "
            f"[B, R] = {found[0]} and {found[1]}: render exactly the named views"
        )
