"""Scenes at the edge of what can be reconstructed: every one trains or is dropped, and its evaluation ends."""

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from tests.reliability.degenerate import SCENES, beside, obey_names
from tests.reliability.steps import first_batches, fit, tiny_run
from vg2gt.evaluation.evaluator import EvaluationOptions, SceneEvaluator
from vg2gt.evaluation.in_training import evaluate_scene
from vg2gt.model import VG2GT, Reconstructor
from vg2gt.rendering import Renderer
from vg2gt.training.loop import Run
from vg2gt.types import Batch

FULL = ("",)
BASELINES = [("model=pixel_aligned",), ("model=voxel_merged",)]
ABLATIONS = [(f"ablation={name}",) for name in ("wo_coarse", "rasterized", "wo_depth", "wo_enhance", "wo_split")]


def make(overrides: tuple[str, ...], folder: Path, cache: Path, patch: pytest.MonkeyPatch) -> tuple[Run, Batch]:
    run = tiny_run(folder, cache, *(override for override in overrides if override))
    (good,) = first_batches(run, 1)
    obey_names(run.module.model.backend, patch)
    return run, good


TRAINED = [(1, FULL)]
TRAINED += [pytest.param(3, model, marks=pytest.mark.slow) for model in (FULL, *ABLATIONS, *BASELINES)]


@pytest.mark.parametrize(("times", "overrides"), TRAINED)
def test_degenerate_scenes_do_no_harm(times, overrides, tmp_path, cache, monkeypatch):
    """Every scene some times in a row, a good one at the end."""
    run, good = make(overrides, tmp_path, cache, monkeypatch)
    scenes = [mutate(good.map(Tensor.clone)) for mutate in SCENES.values() for _ in range(times)]
    audit = fit(run, [*scenes, good])
    audit.assert_sound()
    assert not audit.skipped[-1]


def evaluated(model: Reconstructor, renderer: Renderer, batch: Batch) -> dict[str, float | None]:
    """All figures of both evaluations; fails if one is infinite where a report would show it."""
    scores = SceneEvaluator(model.eval(), renderer, EvaluationOptions())(batch).metrics
    assert all(value is None or math.isfinite(value) for value in scores.values())
    if batch.images.shape[1] > batch.num_context:
        scores = scores | evaluate_scene(model, renderer, batch)
    return scores


EVALUATED = [FULL]
EVALUATED += [pytest.param(model, marks=pytest.mark.slow) for model in (*ABLATIONS, *BASELINES, ("model=pointcloud",))]


@pytest.mark.parametrize("overrides", EVALUATED, ids=" ".join)
def test_degenerate_scenes_can_be_evaluated(overrides, tmp_path, cache, monkeypatch):
    run, good = make(overrides, tmp_path, cache, monkeypatch)
    for mutate in SCENES.values():
        evaluated(run.module.model, run.module.renderer, mutate(good.map(Tensor.clone)))


def test_what_cannot_be_measured_is_not_a_number(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, good = make(FULL, tmp_path, cache, monkeypatch)
    model, renderer = run.module.model, run.module.renderer
    blind = evaluated(model, renderer, SCENES["no depth"](good))
    assert blind["rendered/gt_pose/solid/abs_rel"] is None
    assert math.isnan(blind["abs_rel"] or 0.0)
    assert blind["scene/gaussians"] == 0
    assert math.isfinite(blind["psnr"] or math.nan)
    assert isinstance(model, VG2GT)
    spoil(model.gaussians)
    headless = evaluated(model, renderer, good)
    assert headless["rendered/gt_pose/solid/psnr"] is None
    assert headless["scene/cv"] is None
    assert headless["decoded/after/abs_rel"] is not None
    spoil(model)
    broken = evaluated(model, renderer, good)
    assert broken["decoded/after/abs_rel"] is None
    assert broken["decoded/before/abs_rel"] is not None
    assert broken["scene/gaussians"] == 0


def spoil(module: nn.Module) -> None:
    with torch.no_grad():
        for parameter in module.parameters():
            if parameter.requires_grad:
                parameter.fill_(float("nan"))


@pytest.mark.parametrize("overrides", [(), ("model=voxel_merged",)], ids=" ".join)
def test_far_points_of_two_scenes_can_be_numbered(overrides: tuple[str, ...], tmp_path: Path, cache: Path) -> None:
    small_voxels = ["fine", "coarse"] if not overrides else []
    guards = [f"model.{part}.min_footprint=0" for part in small_voxels] or ["+model.min_footprint=0"]
    run = tiny_run(tmp_path, cache, *overrides, *guards)
    (good,) = first_batches(run, 1)
    far = SCENES["outliers on both sides"](good)
    audit = fit(run, [beside(far, far), beside(good, far), far])
    audit.assert_sound()
    assert audit.skipped == [False] * 3
