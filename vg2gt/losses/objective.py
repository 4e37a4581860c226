"""Training objective: geometry, enhancement and Gaussian losses with one scale per scene (paper, Training)."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from vg2gt.losses.gaussian import GaussianLoss, RenderTargets
from vg2gt.losses.geometry import GeometryLoss, TaskLoss
from vg2gt.losses.truth import ScaleAlignment, Truth, fit_scale, normalize_truth, to_unit
from vg2gt.types import Batch, Cameras, Decoded, Geometry, Render, TensorRecord, check_choice

Record = TypeVar("Record", bound=TensorRecord)


@dataclass(frozen=True)
class EnhancementLoss:
    """Hinge on one task's loss before and after enhancement, for every scene (paper, eqn enhance_loss).

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
        check_choice("loss.enhance.form", self.form, ("improve", "paper_literal"))
        check_choice("loss.enhance.on", self.on, ("total", "reg"))

    def __call__(self, before: TaskLoss, after: TaskLoss) -> Tensor:
        """Returns the unweighted hinge ``[B]``, with gradient for ``after`` only."""
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
            ValueError: if prediction and batch do not match.
        """
        found = prediction.geometry.depth.shape
        expected = (len(batch.scene), batch.num_context, *batch.images.shape[-2:])
        if found != expected:
            raise ValueError(
                f"prediction.geometry.depth is {tuple(found)}, but the batch has context views {expected}: pass the "
                "prediction made from batch.context"
            )
        with torch.autocast(batch.images.device.type, enabled=False):
            # one scale per scene from the prediction to the ground truth's unit: [B]
            truth = normalize_truth(batch.map(_full_precision))
            initial, enhanced = (g.map(_full_precision) for g in (prediction.initial, prediction.geometry))
            context = truth.views(slice(0, batch.num_context))
            twice = context.map(lambda tensor: torch.cat((tensor, tensor)))
            scales = fit_scale(torch.cat((initial.depth, enhanced.depth)), twice, twice.valid).chunk(2)
            initial_scale, scale = scales[0], scales[self.align.source != "initial"]
            if rendered is not None and views is not None and render_cameras is not None:
                rendered, cameras = rendered.map(_full_precision), render_cameras.map(_full_precision)
                views = views.to(rendered.color.device)
                if self.align.source == "rendered":
                    shown = truth.views(views)
                    scale = fit_scale(rendered.depth, shown, shown.valid & self.gaussian.hits(rendered), scale)
            # geometry and enhancement losses of the context views
            valid = context.valid & (initial.depth > 0) & (enhanced.depth > 0)
            before, after = to_unit(initial.detach(), initial_scale), to_unit(enhanced, scale)
            total, terms = self._geometry_terms(before, after, context, valid)
            # losses of the R rendered views
            if rendered is not None and views is not None:
                targets = _render_targets(batch, after, truth, views)
                scenes = [
                    self.gaussian(
                        _one(rendered, i), cameras.scene(i), targets.map(lambda tensor, i=i: tensor[i]), scale[i]
                    )
                    for i in range(len(batch.scene))
                ]
                total = total + torch.stack([self.gaussian.total(found) for found in scenes])
                terms |= {name: torch.stack([found[name] for found in scenes]) for name in scenes[0]}
                terms["rendered"] = self.gaussian.hits(rendered).to(scale.dtype).mean((1, 2, 3))
            # means over scenes
            means = torch.stack([values.detach() for values in terms.values()]).mean(1)
        return LossReport(total.mean(), dict(zip(terms, means, strict=True)), scale, (~truth.known).sum())

    def _geometry_terms(
        self, before: Geometry, after: Geometry, truth: Truth, valid: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Weighted sum and terms ``[B]`` of the geometry and enhancement losses, all in the truth's unit."""
        # one pass for both, as a GPU spends most of its time here on launches
        both = self.geometry(*_stacked(before, after), truth, valid)
        (depth_before, point_before), (depth, point) = ([task[i] for task in both] for i in range(2))
        hinge_depth, hinge_point = self.enhance(depth_before, depth), self.enhance(point_before, point)
        total = self.geometry.depth * depth.total + self.geometry.point * point.total
        terms = {f"depth_{part.name}": getattr(depth, part.name) for part in fields(TaskLoss)}
        terms |= {f"point_{part.name}": getattr(point, part.name) for part in fields(TaskLoss)}
        terms |= {"enhance_depth": hinge_depth, "enhance_point": hinge_point}
        terms |= {"initial_depth": self.enhance.compared(depth_before)}
        terms |= {"initial_point": self.enhance.compared(point_before)}
        return total + self.enhance.weight * (hinge_depth + hinge_point), terms


def _stacked(*geometries: Geometry) -> tuple[Tensor, Tensor, Cameras]:
    """Stacks depth, confidence and cameras of the same views along a new first axis."""
    poses, intrinsics = (
        torch.stack([getattr(geometry.cameras, name) for geometry in geometries])
        for name in ("world_to_camera", "intrinsics")
    )
    depth, conf = (torch.stack([getattr(each, name) for each in geometries]) for name in ("depth", "depth_conf"))
    return depth, conf, Cameras(poses, intrinsics, geometries[0].cameras.size)


def _one(record: Record, scene: int) -> Record:
    """One scene of a record of B scenes (B = 1)."""
    return record.map(lambda tensor: tensor[scene : scene + 1])


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
