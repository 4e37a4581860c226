"""Reconstruction and scoring of one scene for ``vg2gt evaluate``, and its options."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace

import torch

from vg2gt.data.views.drawn import ViewSelection
from vg2gt.evaluation.in_training import CV_QUERIES, render_or_nan
from vg2gt.evaluation.protocols import ground_truth_target_cameras, joint_target_cameras
from vg2gt.evaluation.scene_metrics import (
    align_geometry,
    image_metrics,
    pixels_with_errors,
    point_cloud_metrics,
    rendered_normal_metrics,
    stated_error_metrics,
)
from vg2gt.geometry.precision import half_precision_on_gpu
from vg2gt.metrics import LPIPS, camera_metrics, cv, depth_metrics
from vg2gt.metrics.depth import ALIGNMENTS
from vg2gt.model import Reconstructor
from vg2gt.profiling import clocked, now, peak_memory_mib, reset_peak_memory
from vg2gt.refinement import Observations, RefineOptions, refine
from vg2gt.rendering import Renderer
from vg2gt.types import Batch, Cameras, Prediction, Render, check_choice
from vg2gt.uncertainty import Calibration

MODES = ("solid", "rasterized")
PROTOCOLS = ("novel", "gt_pose", "context")

Metrics = dict[str, float | None]


@dataclass(frozen=True)
class PointOptions:
    """Options of the point-cloud comparison; lengths are in the data's unit.

    Args:
        threshold: distance below which a point counts as correct.
        downsample: edge length of the cells in which one point is kept; None keeps all points.
        cap: distances of at least this length are left out of the means; None: no cap.
    """

    threshold: float = 0.05
    downsample: float | None = 0.02
    cap: float | None = None


@dataclass(frozen=True)
class EvaluationOptions:
    """Options of an evaluation.

    Args:
        selection: selects the views of a scene.
        alignment: alignment of depth, see :func:`vg2gt.metrics.depth_metrics`; the paper uses ``median``.
        depth_range: ``(nearest, farthest)`` in the data's unit; true depths outside count as unknown, for depth,
            normals and points. None: no bound.
        neighbors: number of neighbours k of the uniformity CV.
        points: options of the point-cloud comparison.
        lpips: ``auto`` (weights in torch hub's cache), ``download``, the weights' path, or None: no LPIPS.
        pictures: number of scenes, for each number of views, of which pictures are written.
        refine: number of refinement steps; the refined scene is scored in separate rows. 0: no refinement.
        table: data set in the paper's tables whose rows are printed below ours; None: no rows of the paper.

    Raises:
        ValueError: if the alignment is unknown or the depth range is empty.
    """

    selection: ViewSelection = field(default_factory=ViewSelection)
    alignment: str = "median"
    depth_range: Sequence[float | None] = (None, None)
    neighbors: int = 8
    points: PointOptions = field(default_factory=PointOptions)
    lpips: str | None = "auto"
    pictures: int = 0
    refine: int = 0
    table: str | None = None

    def __post_init__(self) -> None:
        check_choice("evaluation.alignment", self.alignment, ALIGNMENTS)
        if not 0 <= self.nearest < self.farthest:
            raise ValueError(
                f"evaluation.depth_range={list(self.depth_range)} leaves no depth: give [nearest,farthest] with "
                "0 <= nearest < farthest, null for no bound"
            )

    @property
    def nearest(self) -> float:
        """The nearest true depth that counts."""
        return self.depth_range[0] or 0.0

    @property
    def farthest(self) -> float:
        """The farthest true depth that counts."""
        return float("inf") if self.depth_range[1] is None else self.depth_range[1]


@dataclass(frozen=True)
class SceneResult:
    """Result of the evaluation of one scene.

    Attributes:
        metrics: values by path, such as ``rendered/gt_pose/solid/psnr``; None where a value is not available.
        prediction: the reconstruction.
        renders: solid renders by protocol.
    """

    metrics: Metrics
    prediction: Prediction
    renders: Mapping[str, Render]


@dataclass(frozen=True)
class SceneEvaluator:
    """Scores scenes: views rendered in every protocol and mode, decoded depth, cameras, points, uniformity and cost.

    Attributes:
        model: in eval mode, on its device.
        renderer: renderer whose options apply to both modes.
        options: what is compared and how.
        lpips: LPIPS network on the model's device; None: no LPIPS.
        refinement: options of a refinement whose result is scored as well, under ``refined/``; None: no refinement.
        calibration: gives error bounds of the decoded depth, scored under ``stated/``; None: no error bounds.
    """

    model: Reconstructor
    renderer: Renderer
    options: EvaluationOptions
    lpips: LPIPS | None = None
    refinement: RefineOptions | None = None
    calibration: Calibration | None = None

    @torch.no_grad()
    def __call__(self, batch: Batch) -> SceneResult:
        """Evaluates one scene.

        Args:
            batch: one scene (B = 1) on the model's device.

        Raises:
            ValueError: if the batch holds several scenes.
        """
        if len(batch.scene) != 1:
            raise ValueError(f"evaluation takes one scene at a time, got {', '.join(batch.scene)}")
        prediction, cost = self._reconstruct(batch)
        metrics, renders = self._score(batch, prediction, cost)
        if self.refinement is not None:
            refined, cost = self._refine(batch, prediction, self.refinement)
            scores, _ = self._score(batch, refined, cost)
            # refinement does not change the decoded depth
            kept = {name: value for name, value in scores.items() if not name.startswith(("decoded", "stated"))}
            metrics |= _under("refined", kept)
        finite = {name: value if math.isfinite(value) else None for name, value in metrics.items()}  # JSON has no NaN
        return SceneResult(finite, prediction, renders)

    def _score(
        self, batch: Batch, prediction: Prediction, cost: dict[str, float]
    ) -> tuple[dict[str, float], dict[str, Render]]:
        """All metrics of one prediction, and its solid renders by protocol."""
        inside = (batch.depth >= self.options.nearest) & (batch.depth <= self.options.farthest)
        known = replace(batch, depth=torch.where(inside, batch.depth, 0.0))
        metrics: dict[str, float] = {}
        renders: dict[str, Render] = {}
        device = batch.images.device
        for protocol, cameras in self._cameras(batch, prediction).items():
            truth = known.context if protocol == "context" else known.target
            for mode in MODES:
                began = now(device)
                rendered = render_or_nan(self.renderer, prediction.gaussians, cameras, mode)
                seconds = (now(device) - began) / cameras.world_to_camera.shape[1]
                found = image_metrics(rendered, truth, self.lpips) | self._depth_metrics(rendered.depth, truth)
                found |= rendered_normal_metrics(rendered, truth)
                metrics |= _under(f"rendered/{protocol}/{mode}", found)
                if mode == "solid":
                    renders[protocol] = rendered
                    cost["render_seconds"] = seconds
        metrics |= _under("decoded/before", self._depth_metrics(prediction.initial.depth, known.context))
        metrics |= _under("decoded/after", self._depth_metrics(prediction.geometry.depth, known.context))
        if self.calibration is not None:
            predicts = self.model.backend.predicts_cameras
            pixels = pixels_with_errors(prediction, prediction.supported, known.context, predicts)
            bounds = self.calibration.bounds(pixels.evidence, pixels.status)
            metrics |= _under("stated", stated_error_metrics(pixels.error, bounds, pixels.status))
        metrics |= self._pose_and_point_cloud_metrics(known.context, prediction, renders["context"])
        cost["cv"] = cv(prediction.gaussians.means, self.options.neighbors, CV_QUERIES)
        return metrics | _under("scene", cost), renders

    def _refine(
        self, batch: Batch, prediction: Prediction, options: RefineOptions
    ) -> tuple[Prediction, dict[str, float]]:
        """The prediction with Gaussians and cameras optimised on the input views, and the cost."""
        device, geometry = batch.images.device, prediction.geometry
        reset_peak_memory(device)
        began = now(device)
        context = batch.context
        mask = None if context.mask is None else context.mask[0]
        seen = Observations(context.images[0], geometry.depth[0], geometry.depth_conf[0], mask)
        found = refine(prediction.gaussians, geometry.cameras, seen, self.renderer, options)
        gaussians = found.scene.gaussians
        cost = {
            "refine_seconds": now(device) - began,
            "peak_memory_mib": peak_memory_mib(device),
            "gaussians": float(len(gaussians)),
        }
        geometry = replace(geometry, cameras=found.scene.cameras)
        return replace(prediction, gaussians=gaussians, geometry=geometry), cost

    def _reconstruct(self, batch: Batch) -> tuple[Prediction, dict[str, float]]:
        device = batch.images.device
        reset_peak_memory(device)
        with clocked(device) as clock, half_precision_on_gpu(batch.images):
            prediction = self.model(batch.context.images, batch.context.hints)
        gaussians = len(prediction.gaussians)
        return prediction, {
            "gaussians": float(gaussians),
            "gaussians_per_pixel": gaussians / batch.context.depth.numel(),
            "reconstruct_seconds": clock.total,
            "head_seconds": clock.head,
            "peak_memory_mib": peak_memory_mib(device),
        }

    def _cameras(self, batch: Batch, prediction: Prediction) -> dict[str, Cameras]:
        cameras = {"context": prediction.geometry.cameras}
        if batch.images.shape[1] > batch.num_context:
            cameras["novel"] = joint_target_cameras(self.model, batch, prediction)
            cameras["gt_pose"] = ground_truth_target_cameras(batch, prediction)
        return cameras

    def _depth_metrics(self, depth: torch.Tensor, truth: Batch) -> dict[str, float]:
        return depth_metrics(depth[0], truth.depth[0], self.options.alignment)

    def _pose_and_point_cloud_metrics(self, truth: Batch, prediction: Prediction, rendered: Render) -> dict[str, float]:
        metrics: dict[str, float] = {}
        geometry = prediction.geometry
        if truth.num_context > 1:
            metrics |= _under("cameras", camera_metrics(geometry.cameras, truth.cameras))
        similarity = align_geometry(geometry, truth)
        if similarity is not None:
            for name, depth in (("decoded", geometry.depth), ("rendered", rendered.depth)):
                found = point_cloud_metrics(depth, geometry.cameras, truth, similarity, **asdict(self.options.points))
                metrics |= _under(f"points/{name}", found)
        return metrics


def _under(path: str, metrics: Mapping[str, float]) -> dict[str, float]:
    return {f"{path}/{name}": value for name, value in metrics.items()}
