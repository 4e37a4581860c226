"""Training objective: geometry, enhancement and Gaussian losses with one scale per scene (paper, Training)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from vg2gt.losses.gaussian import GaussianLoss, RenderTargets
from vg2gt.losses.geometry import GeometryLoss, TaskLoss, camera_errors
from vg2gt.losses.truth import ScaleAlignment, Truth, normalize_truth, to_unit
from vg2gt.types import Batch, Cameras, Decoded, Geometry, Render, TensorRecord

FORMS = ("improve", "paper_literal")
COMPARED = ("total", "reg")


@dataclass(frozen=True)
class EnhancementLoss:
    """Hinge on one task's loss before and after enhancement, for one scene (paper, eqn enhance_loss).

    The paper prints ``max(0, L_before - L_after)``, which penalises improvement; its text means the opposite.

    Args:
        weight: lambda, the same for both tasks.
        margin: reduction of the loss at which the hinge becomes 0.
        form: ``improve``: ``max(0, L_after - L_before + margin)``; ``paper_literal``: as printed.
        on: ``total`` compares the task's total loss, ``reg`` its plain error.

    Raises:
        ValueError: if ``form`` or ``on`` is not one of these.
    """

    weight: float = 3.0
    margin: float = 0.0
    form: str = "improve"
    on: str = "total"

    def __post_init__(self) -> None:
        if self.form not in FORMS:
            raise ValueError(f"loss.enhance.form must be one of {FORMS}, got {self.form!r}")
        if self.on not in COMPARED:
            raise ValueError(f"loss.enhance.on must be one of {COMPARED}, got {self.on!r}")

    def __call__(self, before: TaskLoss, after: TaskLoss) -> Tensor:
        """Returns the unweighted hinge, a scalar with gradient for ``after`` only."""
        reference, value = self.compared(before).detach(), self.compared(after)
        if self.form == "paper_literal":
            return F.relu(reference - value)
        return F.relu(value - reference + self.margin)

    def compared(self, task: TaskLoss) -> Tensor:
        """Returns the part of a task's loss that is compared."""
        return task.total if self.on == "total" else task.reg


@dataclass(frozen=True)
class LossReport:
    """Result of the objective for one training step.

    Attributes:
        total: scalar with gradient, mean over scenes of the weighted sum of the terms.
        terms: unweighted terms, means over scenes, detached. ``initial_depth`` and ``initial_point`` are the reference
            values of the enhancement loss; ``rendered`` is the share of rendered pixels that show a surface.
        scale: ``[B]`` factor from scene units to the losses' unit.
        skipped: number of scenes with fewer than 100 valid depth pixels, whose depth terms are 0.
    """

    total: Tensor
    terms: dict[str, Tensor]
    scale: Tensor
    skipped: Tensor


@dataclass(frozen=True)
class SceneLoss:
    """One scene's weighted sum and unweighted terms, with gradient."""

    total: Tensor
    terms: dict[str, Tensor]

    def __add__(self, other: SceneLoss) -> SceneLoss:
        return SceneLoss(self.total + other.total, self.terms | other.terms)


@dataclass(frozen=True)
class RenderedViews(TensorRecord):
    """Renders of R views of the batch with ``cameras``; ``views [R]`` int64 are their indices in the batch."""

    render: Render
    cameras: Cameras
    views: Tensor

    def scene(self, index: int) -> tuple[Render, Cameras]:
        """Returns one scene's renders and cameras (B = 1)."""
        return self.render.map(lambda tensor: tensor[index : index + 1]), self.cameras.scene(index)


class VG2GTLoss(nn.Module):
    """Training objective of VG²GT.

    The loss of a scene is the sum of depth and point-map losses of the enhanced geometry, the hinge against the
    backbone's geometry, and the losses of the rendered views. All scenes have equal weight. Ground truth is divided by
    the scene's mean distance from the first camera. One scale per scene, without gradient, converts depth,
    translations, points and rendered depth to that unit.

    Args:
        geometry: depth and point-map losses; defaults to those of VGGT.
        enhance: enhancement hinge; defaults to ``form="improve"``.
        gaussian: losses of rendered views; defaults to the paper's weights.
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
        prediction: Decoded,
        batch: Batch,
        rendered: Render | None = None,
        views: Tensor | None = None,
        render_cameras: Cameras | None = None,
    ) -> LossReport:
        """Computes the objective in float32 (float64 stays float64) under any autocast.

        Args:
            prediction: geometry of the context views, in the frame of context view 0 and in scene units.
            batch: ground truth of context and held-out views.
            rendered: renders of some views of the batch, or None for the geometry losses only.
            views: ``[R]`` int64, indices of the rendered views in the batch; the first ``num_context`` of the batch
                have decoded depth.
            render_cameras: the R cameras used for rendering.

        Raises:
            ValueError: if geometry, renders, views and cameras do not match.
        """
        shown = _checked(prediction, batch, rendered, views, render_cameras)
        with torch.autocast(batch.images.device.type, enabled=False):
            # one scale per scene from the prediction to the ground truth's unit: [B]
            truth = normalize_truth(batch.map(_full_precision))
            initial, enhanced = (g.map(_full_precision) for g in (prediction.initial, prediction.geometry))
            initial_scale = self.align.fit(initial, truth)
            scale = initial_scale if self.align.source == "initial" else self.align.fit(enhanced, truth)
            if shown is not None:
                hits = self.gaussian.hits(shown.render)
                scale = self.align.fit_rendered(shown.render.depth, hits, shown.views, truth, scale)
            # geometry and enhancement losses of the context views
            context = truth.views(slice(0, batch.num_context))
            valid = context.valid & (initial.depth > 0) & (enhanced.depth > 0)
            before, after = to_unit(initial, initial_scale), to_unit(enhanced, scale)
            scenes = [
                self._geometry_terms(_one(before, i), _one(after, i), context.scene(i), valid[i : i + 1])
                for i in range(len(batch.scene))
            ]
            # losses of the R rendered views
            if shown is not None:
                targets = _render_targets(batch, after, truth, shown.views)
                scenes = [
                    scene + self._gaussian_terms(*shown.scene(i), targets.scene(i), scale[i])
                    for i, scene in enumerate(scenes)
                ]
            # means over scenes
            total = torch.stack([scene.total for scene in scenes]).mean()
            terms = {name: torch.stack([s.terms[name].detach() for s in scenes]).mean() for name in scenes[0].terms}
        return LossReport(total, terms, scale, (~truth.known).sum())

    def _geometry_terms(self, before: Geometry, after: Geometry, truth: Truth, valid: Tensor) -> SceneLoss:
        """Returns the geometry and enhancement losses of one scene, all in the truth's unit."""
        with torch.no_grad():
            depth_before, point_before = self.geometry(before.depth, before.depth_conf, before.cameras, truth, valid)
        depth, point = self.geometry(after.depth, after.depth_conf, after.cameras, truth, valid)
        hinge_depth, hinge_point = self.enhance(depth_before, depth), self.enhance(point_before, point)
        total = self.geometry.depth * depth.total + self.geometry.point * point.total
        terms = {f"depth_{part}": getattr(depth, part) for part in ("conf", "reg", "grad")}
        terms |= {f"point_{part}": getattr(point, part) for part in ("conf", "reg", "grad")}
        terms |= {"enhance_depth": hinge_depth, "enhance_point": hinge_point}
        terms |= {"initial_depth": self.enhance.compared(depth_before)}
        terms |= {"initial_point": self.enhance.compared(point_before)}
        terms |= camera_errors(after.cameras, truth.cameras)
        return SceneLoss(total + self.enhance.weight * (hinge_depth + hinge_point), terms)

    def _gaussian_terms(self, render: Render, cameras: Cameras, targets: RenderTargets, scale: Tensor) -> SceneLoss:
        """Returns the losses of one scene's rendered views."""
        terms = self.gaussian(render, cameras, targets, scale)
        share = self.gaussian.hits(render).to(scale.dtype).mean()
        return SceneLoss(self.gaussian.total(terms), terms | {"rendered": share})


def _one(geometry: Geometry, index: int) -> Geometry:
    """Returns one scene's geometry (B = 1)."""
    return geometry.map(lambda tensor: tensor[index : index + 1])


def _render_targets(batch: Batch, geometry: Geometry, truth: Truth, views: Tensor) -> RenderTargets:
    """Builds the targets ``[B, R, ...]`` of the rendered views; ``geometry`` is in the losses' unit."""
    is_context = views < batch.num_context
    source = torch.where(is_context, views, 0)
    shown = truth.views(views)
    known = truth.known[:, None, None, None]
    decoded = geometry.depth[:, source]
    return RenderTargets(
        images=_full_precision(batch.images[:, views]),
        depth=shown.depth,
        valid=shown.valid & known,
        intrinsics=shown.cameras.intrinsics,
        decoded=decoded,
        decoded_conf=geometry.depth_conf[:, source],
        decoded_valid=(decoded > 0) & is_context[:, None, None],
        comparable=torch.ones_like(known),  # without true depth, both are in scene units
        mask=None if batch.mask is None else _full_precision(batch.mask[:, views]),
    )


def _full_precision(tensor: Tensor) -> Tensor:
    return tensor.float() if tensor.dtype in (torch.float16, torch.bfloat16) else tensor


def _checked(
    prediction: Decoded, batch: Batch, rendered: Render | None, views: Tensor | None, cameras: Cameras | None
) -> RenderedViews | None:
    """Checks that all inputs match; returns the rendered views in full precision, if there are any."""
    expected = (len(batch.scene), batch.num_context, *batch.images.shape[-2:])
    for name, geometry in (("initial", prediction.initial), ("geometry", prediction.geometry)):
        if tuple(geometry.depth.shape) != expected:
            raise ValueError(
                f"prediction.{name}.depth is {tuple(geometry.depth.shape)}, but the batch has context views "
                f"{expected}: pass the prediction made from batch.context"
            )
    if rendered is None:
        return None
    if views is None or cameras is None:
        raise ValueError("rendered= requires views= (indices of the rendered views in the batch) and render_cameras=")
    found = (tuple(rendered.color.shape[:2]), tuple(cameras.world_to_camera.shape[:2]))
    if found != ((len(batch.scene), len(views)),) * 2:
        raise ValueError(
            f"views= selects {len(views)} views of {len(batch.scene)} scenes, but rendered and render_cameras have "
            f"[B, R] = {found[0]} and {found[1]}: render exactly the selected views"
        )
    return RenderedViews(rendered, cameras, views.to(rendered.color.device)).map(_full_precision)
