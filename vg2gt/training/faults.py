"""Numeric faults of training steps: found where they begin, named, counted; too many in a row end the run.

A step with a fault changes neither weights nor optimiser moments, on any rank. It still counts as a step: the data, the
random draws and the learning rate go on as if it had been one, so that a resumed run meets the same steps.
"""

from __future__ import annotations

import logging
import statistics
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.hooks import RemovableHandle

from vg2gt.losses import LossReport
from vg2gt.training.distributed import all_gather_object
from vg2gt.types import Batch, Prediction, TensorRecord

log = logging.getLogger(__name__)

MEDIAN_OF = 50  # steps
GROWTH = 10.0
KEPT = 20  # faults named in the report of a run


@dataclass(frozen=True)
class Fault:
    """What one process found wrong with a step.

    Attributes:
        scenes: the scenes at fault; all of the process's batch where they cannot be told apart.
        cause: what was not finite.
        step: number of the optimiser's step.
        rank: the process.
    """

    scenes: tuple[str, ...]
    cause: str
    step: int = 0
    rank: int = 0

    def __str__(self) -> str:
        return f"rank {self.rank}, {', '.join(self.scenes)}: {self.cause}"


def fault_of_batch(batch: Batch) -> Fault | None:
    """Finds NaN, infinity or focal lengths that are not positive in the data, before a model sees them."""
    focal = batch.cameras.intrinsics[..., [0, 1], [0, 1]]
    parts = {
        "images": batch.images,
        "depth": batch.depth,
        "world_to_camera": batch.cameras.world_to_camera,
        "intrinsics": torch.where(focal > 0, batch.cameras.intrinsics.sum((-2, -1), keepdim=True)[..., 0], torch.nan),
    }
    if _all_finite(*parts.values()):
        return None
    bad = {name: ~torch.isfinite(tensor.flatten(1)).all(1) for name, tensor in parts.items()}
    scenes = tuple(name for i, name in enumerate(batch.scene) if any(bool(rows[i]) for rows in bad.values()))
    return Fault(scenes, f"{_listed(name for name, rows in bad.items() if rows.any())} of the batch")


def fault_of_prediction(prediction: Prediction, scenes: tuple[str, ...]) -> Fault | None:
    """Finds NaN or infinity in the Gaussians; names the part of the prediction where it begins."""
    gaussians = _tensors(replace(prediction.gaussians, background=None), "Gaussians'")  # that is the images' mean
    if _all_finite(*gaussians.values()):
        return None
    stages = _tensors(prediction.initial.cameras, "backbone's") | {"unit of the scene": prediction.unit}
    stages |= _tensors(prediction.voxels, "voxels'") if prediction.voxels is not None else {}
    first = next(name for name, tensor in (stages | gaussians).items() if not _all_finite(tensor))
    bad = torch.zeros(len(prediction.gaussians), dtype=torch.bool, device=prediction.gaussians.means.device)
    for tensor in gaussians.values():
        bad |= ~torch.isfinite(tensor.detach()).reshape(len(bad), -1).all(1)
    return Fault(tuple(scenes[i] for i in prediction.gaussians.batch[bad].unique().tolist()), first)


def fault_of_loss(report: LossReport, scenes: tuple[str, ...]) -> Fault | None:
    """Finds a loss that is not finite; names the terms and the scenes."""
    if _all_finite(report.total):
        return None
    terms = [[name for name, value in scene.items() if not _all_finite(value)] for scene in report.by_scene]
    bad = tuple(name for name, found in zip(scenes, terms, strict=True) if found)
    names = dict.fromkeys(name for found in terms for name in found)
    if not names:  # finite terms whose sum overflows
        return Fault(scenes, "the loss is not finite, all its terms are")
    return Fault(bad, f"loss {'terms' if len(names) > 1 else 'term'} {_listed(names)}")


class GradientWatch:
    """Sees every parameter's gradient as it is computed, before ranks average theirs.

    Afterwards a fault of one rank is a fault of all, in every parameter; the first bad gradient tells where it began.

    Args:
        parameters: names and parameters to watch.
    """

    def __init__(self, parameters: Iterable[tuple[str, nn.Parameter]]) -> None:
        self._sums: list[tuple[str, Tensor]] = []
        self._handles: list[RemovableHandle] = [
            parameter.register_hook(lambda gradient, name=name: self._see(name, gradient))
            for name, parameter in parameters
        ]

    def _see(self, name: str, gradient: Tensor) -> None:
        self._sums.append((name, gradient.detach().sum()))  # looked at only if a step went wrong: no wait for a GPU

    def clear(self) -> None:
        """Forgets the gradients of the step before."""
        self._sums.clear()

    def first_bad(self) -> str | None:
        """The first parameter whose gradient of this step was not finite, in the order of the backward pass."""
        return next((name for name, total in self._sums if not _all_finite(total)), None)

    def remove(self) -> None:
        """Stops watching."""
        for handle in self._handles:
            handle.remove()


class GradientGrowth:
    """Warns when gradients are tenfold of what they were: a training that diverges shows it there first.

    Medians of :data:`MEDIAN_OF` steps are compared with that of the first ones, so that single steps are no alarm. It
    is said again when they have grown tenfold once more.
    """

    def __init__(self) -> None:
        self._norms: list[float] = []
        self._usual: float | None = None

    def see(self, norm: float, step: int, warn: bool = True) -> None:
        """Notes the gradient norm of a step that was taken."""
        self._norms.append(norm)
        if len(self._norms) < MEDIAN_OF:
            return
        recent = statistics.median(self._norms)
        self._norms.clear()
        if self._usual is None:
            self._usual = recent
        elif recent > GROWTH * self._usual:
            if warn:
                log.warning(
                    "step %d: gradient norms have grown from %.3g to %.3g (medians of %d steps): the training may "
                    "diverge. Lower optimizer.lr, or look at train/* in the log for the term that grows",
                    step, self._usual, recent, MEDIAN_OF,
                )  # fmt: skip
            self._usual = recent


class SkippedSteps:
    """Counts the steps that were dropped.

    Args:
        limit: most steps dropped in a row.

    Attributes:
        total: steps dropped since the run began.
        in_a_row: steps dropped since the last good one.
        faults: the first faults of the run, at most :data:`KEPT`.

    Raises:
        ValueError: if the limit is below 1.
    """

    def __init__(self, limit: int) -> None:
        if limit < 1:
            raise ValueError(f"training.max_skipped must be at least 1, got {limit}")
        self.limit = limit
        self.total = 0
        self.in_a_row = 0
        self.faults: list[Fault] = []
        self._scenes: dict[str, None] = {}

    def good(self) -> None:
        """Notes a step that was taken."""
        self.in_a_row = 0
        self._scenes.clear()

    def add(self, faults: list[Fault]) -> None:
        """Notes a dropped step and what every rank found.

        Raises:
            FloatingPointError: if it is one too many in a row.
        """
        self.total += 1
        self.in_a_row += 1
        self.faults = (self.faults + faults)[:KEPT]
        self._scenes |= dict.fromkeys(scene for fault in faults for scene in fault.scenes)
        if self.in_a_row >= self.limit:
            raise FloatingPointError(
                f"{self.in_a_row} steps in a row had a non-finite loss or gradient, the last: {described(faults)}. "
                f"Scenes of these steps: {_listed(self._scenes)}. Look at these scenes, lower optimizer.lr, or raise "
                "training.max_skipped"
            )

    def summary(self) -> dict[str, Any]:
        """What a run's report says: the number of dropped steps and the first faults."""
        faults = [asdict(fault) | {"scenes": list(fault.scenes)} for fault in self.faults]
        return {"total": self.total, "faults": faults}

    def state_dict(self) -> dict[str, Any]:
        """Plain values for a checkpoint."""
        return self.summary() | {"in_a_row": self.in_a_row, "scenes": list(self._scenes)}

    def load_state_dict(self, state: dict[str, Any] | int) -> None:
        """Goes on counting where a checkpoint stopped; the first checkpoints held the total alone."""
        if isinstance(state, int):
            self.total = state
            return
        self.total, self.in_a_row = state["total"], state["in_a_row"]
        self.faults = [Fault(**{**fault, "scenes": tuple(fault["scenes"])}) for fault in state["faults"]]
        self._scenes = dict.fromkeys(state["scenes"])


def gather_faults(fault: Fault | None) -> list[Fault]:
    """The faults of all ranks, in their order. Collective: every rank has to call it."""
    return [each for each in all_gather_object(fault) if each]


def described(faults: list[Fault]) -> str:
    """One line about a dropped step."""
    return "; ".join(map(str, faults)) or "the gradient's norm overflows"


def _tensors(record: TensorRecord, owner: str) -> dict[str, Tensor]:
    """The floating-point tensors of a record by name."""
    values = {f"{owner} {field.name}": getattr(record, field.name) for field in fields(record)}
    return {name: value for name, value in values.items() if isinstance(value, Tensor) and value.is_floating_point()}


def _all_finite(*tensors: Tensor) -> bool:
    """Whether all of them are; the host waits for a GPU once where they are."""
    sums = torch.stack([tensor.detach().sum().float() for tensor in tensors])  # what is not finite shows in a sum
    return bool(sums.isfinite().all()) or bool(
        torch.stack([tensor.detach().isfinite().all() for tensor in tensors]).all()
    )


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names)
