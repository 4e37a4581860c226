"""Lightning module of VG²GT: training and evaluation steps, optimiser, logging, checkpoints of the trained part."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Literal, get_args

import lightning
import torch
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from vg2gt.evaluation.in_training import evaluate_scene
from vg2gt.evaluation.protocols import training_cameras
from vg2gt.geometry.cameras import focal_lengths
from vg2gt.geometry.pose_noise import with_pose_noise
from vg2gt.losses import LossReport
from vg2gt.memory import dropped_by
from vg2gt.model import VG2GT, Reconstructor
from vg2gt.profiling import stage
from vg2gt.rendering import Renderer, UnrenderableError
from vg2gt.runs.checkpoints import MADE_OF, MODEL_PREFIX, model_state
from vg2gt.training.casts import WeightCasts
from vg2gt.training.distributed import SkippedSteps, all_gather_object, finite, world_size
from vg2gt.types import Batch, Prediction

log = logging.getLogger(__name__)

Part = Literal["all", "coarse"]
_IN_PROGRESS_BAR = ("loss", "train/color_l1", "train/depth_gt", "train/depth_reg", "train/normal")


class VG2GTModule(lightning.LightningModule):
    """Trains the model's trainable parameters; by default everything except the backbone (paper, Training).

    Args:
        model: reconstruction model.
        loss: training objective.
        renderer: renders the training and evaluation views.
        optimizer: builds the optimiser from parameter groups (Hydra partial); its ``lr`` is the initial learning rate.
        final_lr: learning rate at the end of the cosine schedule.
        warmup_steps: steps of linear warm-up; 0 for none.
        coarse_lr_factor: multiplies the learning rate of the coarse module; > 0.
        backend_lr_factor: multiplies the learning rate of the backbone, if it is trained; > 0.
        part: what to train: ``all``, or only the ``coarse`` module, with the geometry and enhancement losses and
            without rendering.
        pose_noise: fraction of training scenes whose camera hints are perturbed, 0 to 1. Requires ``part="coarse"``,
            as rendered views need accurate cameras.
        render_views: maximum number of views rendered per training step, held-out views first; None renders all.
        rasterized_depth: also evaluate the depth of 3DGS rasterisation (``abs_rel_rasterized``).
        compile_blocks: compile the backbone's transformer blocks (:meth:`backends.base.Backend.compile_blocks`).
        max_skipped: stop after this many consecutive steps with a non-finite loss or gradient.
        seed: combined with the step number to seed every random draw of a step, so that a resumed run makes the same
            draws as an uninterrupted one.

    Raises:
        ValueError: if an option is out of range or does not fit the model.
    """

    def __init__(
        self,
        model: Reconstructor,
        loss: nn.Module,
        renderer: Renderer,
        optimizer: Callable[..., Optimizer],
        final_lr: float = 1e-8,
        warmup_steps: int = 0,
        coarse_lr_factor: float = 1.0,
        backend_lr_factor: float = 0.1,
        part: Part = "all",
        pose_noise: float = 0.0,
        render_views: int | None = None,
        rasterized_depth: bool = False,
        compile_blocks: bool = False,
        max_skipped: int = 20,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.lr_factors = {"coarse": coarse_lr_factor, "backend": backend_lr_factor}
        for name, factor in self.lr_factors.items():
            if not 0 < factor < math.inf:  # the optimiser only checks its own learning rate
                raise ValueError(f"training.{name}_lr_factor={factor} must be a positive number")
        if render_views is not None and render_views < 1:
            raise ValueError(f"training.render_views={render_views} must be at least 1, or null for all")
        if part not in get_args(Part) or (pose_noise and part == "all") or not 0 <= pose_noise <= 1:
            raise ValueError(
                f"training.part={part} must be all or coarse, and training.pose_noise={pose_noise} a fraction of the "
                "scenes, 0 with part=all: rendered views need accurate cameras to match the images"
            )
        if compile_blocks:
            model.backend.compile_blocks()
        self.model = model
        self.part = part
        if part == "coarse":
            _leave_only_coarse(model)
        self.casts = WeightCasts(model)
        self.pose_noise = pose_noise
        self.loss = loss
        self.renderer = renderer
        self.make_optimizer = optimizer
        self.final_lr = final_lr
        self.warmup_steps = warmup_steps
        self.render_views = render_views
        self.rasterized_depth = rasterized_depth
        self.seed = seed
        self.generator = torch.Generator()
        self.skipped = SkippedSteps(max_skipped)
        self._cause: str | None = None  # why the current step must be skipped
        self._report: LossReport | None = None  # of the current step
        self._scenes: tuple[str, ...] = ()
        self._figures: dict[str, Tensor] = {}
        self._metrics: dict[tuple[str, tuple[int, ...]], dict[str, float]] = {}
        self.made_of: str | None = None  # configuration of the model's parts as YAML, stored in checkpoints
        self.strict_loading = (
            False  # weights of a frozen backbone are not stored; load_state_dict checks everything else
        )

    # ------------------------------------------------------------------------------------------------- training

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        """Seeds the random draws of this step: ``self.generator`` equally on all ranks, torch's generator per rank."""
        step_seed = (self.seed * 1_000_003 + self.global_step) * 1009
        self.generator.manual_seed(step_seed)  # curve orders, rendered views
        torch.manual_seed(step_seed + self.global_rank)  # drop path

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Returns the training loss; NaN if batch or prediction is bad. All ranks skip a step that is not finite."""
        self._scenes, self._figures, self._cause, self._report = batch.scene, {}, None, None
        with self.casts(batch.images):
            report = self._losses(batch)
        if report is not None:
            self._report = replace(report, total=report.total.detach())
            self._figures |= self._step_figures(report)
            return report.total
        # use every parameter, as DDP expects
        return torch.stack([parameter.sum() for parameter in self.model.trained_parameters()]).sum() * torch.nan

    def _losses(self, batch: Batch) -> LossReport | None:
        """Returns the training losses; None if the step cannot be computed (sets ``_cause``)."""
        focal = focal_lengths(batch.cameras.intrinsics)
        if not finite(batch.images, batch.depth, batch.cameras.world_to_camera, batch.cameras.intrinsics, focal.log()):
            self._cause = "images, depth or cameras of the batch"
            return None
        return self._losses_of_geometry(batch) if self.part == "coarse" else self._losses_of_scene(batch)

    def _losses_of_geometry(self, batch: Batch) -> LossReport:
        """Geometry and enhancement losses on the context views decoded from enhanced tokens."""
        assert isinstance(self.model, VG2GT)
        hints = with_pose_noise(batch.context, self.pose_noise)
        _, decoded = self.model.enhance(batch.context.images, hints, self.generator)
        with stage("loss"):
            return self.loss(decoded, batch)

    def _losses_of_scene(self, batch: Batch) -> LossReport | None:
        """All losses: on the decoded geometry of the context views and on the rendered views."""
        prediction = self.model(batch.context.images, batch.context.hints, self.generator)
        gaussians = prediction.gaussians
        views = self._draw_views(batch)
        cameras = training_cameras(self.model, batch, prediction).select(views.to(self.device))
        try:
            with stage("render"):
                rendered = self.renderer(gaussians, cameras)
        except UnrenderableError as error:
            values = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
            self._cause = f"nothing to render: {error}" if finite(*values) else "Gaussians"
            return None
        self._figures = self._scene_figures(batch, prediction)
        with stage("loss"):
            return self.loss(prediction, batch, rendered, views, cameras)

    def _draw_views(self, batch: Batch) -> Tensor:
        """Draws the views to render: held-out views first, with at least one context view for the depth losses."""
        total = batch.images.shape[1]
        context = torch.randperm(batch.num_context, generator=self.generator)
        held_out = batch.num_context + torch.randperm(total - batch.num_context, generator=self.generator)
        if self.render_views is not None:
            held_out = held_out[: max(self.render_views - 1, 0)]
        return torch.cat((held_out, context))[: self.render_views]

    def _step_figures(self, report: LossReport) -> dict[str, Tensor]:
        """Values to log; their mean over ranks equals what one process with all scenes would log."""
        figures: dict[str, Tensor | float] = {"loss": report.total.detach()}
        figures |= {f"train/{name}": value for name, value in report.terms.items()}
        figures |= {f"train/{what}_dropped": float(count) for what, count in dropped_by(self.model).items()}
        figures["train/scenes_without_depth"] = report.skipped * world_size()
        return self._scalars(figures)

    def _scene_figures(self, batch: Batch, prediction: Prediction) -> dict[str, Tensor]:
        """Gaussians per context view and voxels per pixel."""
        figures = {"train/gaussians_per_view": len(prediction.gaussians) / (len(batch.scene) * batch.num_context)}
        if prediction.voxels is not None:
            figures["train/voxels_per_pixel"] = len(prediction.voxels.grid) / batch.context.depth.numel()
        return self._scalars(figures)

    def _scalars(self, figures: Mapping[str, Tensor | float]) -> dict[str, Tensor]:
        """Converts to float32; numbers are created on the device, as a copy would make the host wait."""
        return {
            name: value.float() if isinstance(value, Tensor) else torch.full((), value, device=self.device)
            for name, value in figures.items()
        }

    def _log_step(self, average: bool) -> None:
        """Logs the step's values: means over ranks, or this rank's own values if the step was skipped."""
        if not self._figures:
            return
        values = torch.stack(list(self._figures.values()))
        if average:
            values = self.trainer.strategy.reduce(values, reduce_op="mean")
        for name, value in zip(self._figures, values, strict=True):
            self.log(name, value, prog_bar=name in _IN_PROGRESS_BAR)

    def configure_gradient_clipping(
        self,
        optimizer: Optimizer,
        gradient_clip_val: int | float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clips the global gradient norm; skips the step on all ranks if a loss or gradient is non-finite on any."""
        norm = nn.utils.clip_grad_norm_(self.model.trained_parameters(), gradient_clip_val or math.inf)
        good = norm.isfinite() if self._report is None else norm.isfinite() & self._report.total.isfinite()
        bad = torch.ones_like(norm) if self._cause is not None else (~good).to(norm.dtype)
        # All ranks see the same sum, so either all skip the step or none does. The host waits here.
        bad_ranks = float(self.trainer.strategy.reduce(bad, reduce_op="sum"))
        if bad_ranks:
            # Without gradients, the optimiser leaves parameters and moments unchanged.
            optimizer.zero_grad(set_to_none=True)
            self._skip_step()
        else:
            self.skipped.in_a_row = 0
        self._log_step(average=not bad_ranks)
        self.log("train/grad_norm", norm.detach())
        self.log("train/skipped_steps", float(self.skipped.total))

    def _skip_step(self) -> None:
        """Counts a skipped step and logs the fault of each rank."""
        cause = self._cause or "gradient"  # averaged, so non-finite on all ranks
        if self._report is not None and not finite(self._report.total):
            bad = [name for name, value in self._report.terms.items() if not finite(value)]
            cause = f"loss ({', '.join(bad) or 'finite terms, infinite sum'})"
        found = all_gather_object(
            f"step {self.global_step}, rank {self.global_rank}, {', '.join(self._scenes)}: {cause}"
        )
        faults = [fault for fault in found if not fault.endswith(": gradient")] or found
        if self.trainer.is_global_zero:
            log.warning("skipped a step with non-finite values: %s", "; ".join(faults))
        self.skipped.add(faults)

    def configure_optimizers(self) -> dict[str, Any]:
        """Returns the optimiser of the trained parameters and a per-step cosine schedule over the whole run."""
        optimizer = self.make_optimizer(parameter_groups(self.model, self.lr_factors))
        initial_lr = optimizer.param_groups[0]["lr"]
        for group in optimizer.param_groups:
            group["lr"] *= group.pop("lr_factor", 1.0)
        steps = int(self.trainer.estimated_stepping_batches)
        factor = cosine_with_warmup(steps, self.warmup_steps, self.final_lr / initial_lr)
        scheduler = LambdaLR(optimizer, factor)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    # ----------------------------------------------------------------------------------------------- evaluation

    def on_validation_epoch_start(self) -> None:
        """Clears the metrics of the previous evaluation."""
        self._metrics = {}

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Evaluates a batch of scenes on their held-out views."""
        for index, scene in enumerate(batch.scene):
            sample = (scene, tuple(batch.frame_ids[index].tolist()))
            self._metrics[sample] = evaluate_scene(
                self.model, self.renderer, batch.single(index), self.rasterized_depth
            )

    def on_validation_epoch_end(self) -> None:
        """Logs means over the scenes of all ranks, in the same order on any number of them, as ``eval/<name>``."""
        found = {sample: metrics for part in all_gather_object(self._metrics) for sample, metrics in part.items()}
        for sample in sorted(found):
            for name, value in found[sample].items():
                if math.isfinite(value):  # a scene without ground-truth depth has no depth error
                    self.log(f"eval/{name}", value, on_epoch=True, batch_size=1)

    # ---------------------------------------------------------------------------------------------- checkpoints

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keeps only the trained part; adds the backbone's identity, skipped steps and the model's configuration."""
        checkpoint["state_dict"] = {MODEL_PREFIX + name: value for name, value in self.model.trained_state().items()}
        checkpoint["backend"] = dict(self.model.backend.identity())
        checkpoint["skipped_steps"] = self.skipped.state_dict()
        if self.made_of is not None:
            checkpoint[MADE_OF] = self.made_of

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restores the count of skipped steps; raises ValueError if the checkpoint has another backbone."""
        self.model.check_backend(checkpoint.get("backend"))
        self.skipped.load_state_dict(checkpoint["skipped_steps"])

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False):
        """Loads the trained part; only backbone weights may be missing."""
        self.model.load_trained(model_state(state_dict), self.model.backend.identity())


def _leave_only_coarse(model: Reconstructor) -> None:
    """Freezes all but the coarse module."""
    if not isinstance(model, VG2GT) or model.coarse is None:
        raise ValueError(
            "training.part=coarse requires a coarse module, which this model lacks: use model=tiny or another VG2GT "
            "model without ablation=wo_coarse, or training.part=all"
        )
    for name, parameter in model.named_parameters():
        parameter.requires_grad_(parameter.requires_grad and name.startswith("coarse."))


def cosine_with_warmup(steps: int, warmup_steps: int, final_factor: float) -> Callable[[int], float]:
    """Returns a function from step to learning-rate factor: linear warm-up to 1, then cosine decay.

    Args:
        steps: total number of steps.
        warmup_steps: steps of linear warm-up.
        final_factor: factor at ``steps`` and after.
    """

    def factor(step: int) -> float:
        if step < warmup_steps:
            return (step + 1) / (warmup_steps + 1)
        progress = min(1.0, (step - warmup_steps) / max(1, steps - warmup_steps))
        return final_factor + (1 - final_factor) * 0.5 * (1 + math.cos(math.pi * progress))

    return factor


def parameter_groups(module: nn.Module, factors: Mapping[str, float] | None = None) -> list[dict[str, Any]]:
    """Splits the trainable parameters into optimiser groups; vectors (biases, norms, gains) get no weight decay.

    Args:
        module: module whose parameters to split.
        factors: learning-rate factor by name of the direct child module. Children with a factor other than 1 get groups
            of their own, with the factor as ``lr_factor``.

    Returns:
        Groups with named parameters as ``params``.
    """
    apart = {name: factor for name, factor in (factors or {}).items() if factor != 1}
    groups = []
    for child in ("", *apart):
        for decays in (True, False):
            parameters = [
                (name, parameter)
                for name, parameter in module.named_parameters()
                if parameter.requires_grad and (parameter.dim() > 1) is decays and _child(name, apart) == child
            ]
            if parameters:
                options = ({} if decays else {"weight_decay": 0.0}) | ({"lr_factor": apart[child]} if child else {})
                groups.append({"params": parameters, **options})
    return groups


def _child(name: str, apart: Mapping[str, float]) -> str:
    """The child module of a parameter's name if it is one of ``apart``, else an empty string."""
    child = name.partition(".")[0]
    return child if child in apart else ""
