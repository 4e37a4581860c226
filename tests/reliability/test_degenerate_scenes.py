"""Scenes at the edge of what can be reconstructed: every one trains or is dropped, and its evaluation ends."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tests.reliability.degenerate import SCENES, beside, obey_names, random_mutation
from tests.reliability.steps import first_batches, fit, tiny_run
from vg2gt.evaluation.evaluator import SceneEvaluator
from vg2gt.evaluation.in_training import evaluate_scene
from vg2gt.evaluation.options import EvaluationOptions
from vg2gt.model import VG2GT, Reconstructor
from vg2gt.rendering import Renderer
from vg2gt.training.loop import Run
from vg2gt.types import Batch

FULL = ("",)
BASELINES = [("model=pixel_aligned",), ("model=voxel_merged",)]
ABLATIONS = [(f"ablation={name}",) for name in ("wo_coarse", "rasterized", "wo_depth", "wo_enhance", "wo_split")]
OPTIONS = [
    ("model.scale.source=focal",),
    ("model.scale.source=groundtruth",),
    ("backend.background=1.2",),
    ("model.gaussians.sh_degree=2",),
    ("loss=paper",),
    ("loss.align.source=rendered",),
    ("loss.gaussian.normal_target=render",),
]


def make(overrides: tuple[str, ...], folder: Path, cache: Path, patch: pytest.MonkeyPatch) -> tuple[Run, Batch]:
    run = tiny_run(folder, cache, *(override for override in overrides if override))
    (good,) = first_batches(run, 1)
    obey_names(run.module.model.backend, patch)
    return run, good


def degenerate(good: Batch, times: int) -> list[Batch]:
    """Every scene several times in a row, a good one at the end."""
    return [mutate(good.map(Tensor.clone)) for mutate in SCENES.values() for _ in range(times)] + [good]


def check_training(
    overrides: tuple[str, ...], times: int, folder: Path, cache: Path, patch: pytest.MonkeyPatch
) -> None:
    run, good = make(overrides, folder, cache, patch)
    audit = fit(run, degenerate(good, times))
    audit.assert_sound()
    assert not audit.skipped[-1]


@pytest.mark.parametrize("overrides", [FULL, BASELINES[1]], ids=" ".join)
def test_degenerate_scenes_do_no_harm(overrides, tmp_path, cache, monkeypatch):
    check_training(overrides, 1, tmp_path, cache, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("overrides", [FULL, *ABLATIONS, *BASELINES, *OPTIONS], ids=" ".join)
def test_degenerate_scenes_do_no_harm_in_several_steps(overrides, tmp_path, cache, monkeypatch):
    check_training(overrides, 3, tmp_path, cache, monkeypatch)


def evaluated(model: Reconstructor, renderer: Renderer, batch: Batch) -> dict[str, float | None]:
    """All figures of both evaluations; fails if one is infinite where a report would show it."""
    scores = SceneEvaluator(model.eval(), renderer, EvaluationOptions())(batch).metrics
    assert all(value is None or math.isfinite(value) for value in scores.values())
    if batch.images.shape[1] > batch.num_context:
        scores = scores | evaluate_scene(model, renderer, batch)
    return scores


def check_evaluation(overrides: tuple[str, ...], folder: Path, cache: Path, patch: pytest.MonkeyPatch) -> None:
    run, good = make(overrides, folder, cache, patch)
    for mutate in SCENES.values():
        evaluated(run.module.model, run.module.renderer, mutate(good.map(Tensor.clone)))


def test_degenerate_scenes_can_be_evaluated(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    check_evaluation(FULL, tmp_path, cache, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize(
    "overrides",
    [*ABLATIONS, *BASELINES, *OPTIONS, ("model=pointcloud",), ("model=pointcloud", "model.spacing=neighbors")],
    ids=" ".join,
)
def test_degenerate_scenes_can_be_evaluated_by_every_model(overrides, tmp_path, cache, monkeypatch):
    check_evaluation(overrides, tmp_path, cache, monkeypatch)


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


def check_random_scenes(first_seed: int, count: int, folder: Path, cache: Path, patch: pytest.MonkeyPatch) -> None:
    """Trains on random mutations in the order of their seeds, half of them in a batch beside a good scene."""
    run, good = make(FULL, folder, cache, patch)
    batches, labels = [], []
    for seed in range(first_seed, first_seed + count):
        label, mutate = random_mutation(np.random.default_rng(seed))
        batches.append(beside(good, mutate(good)) if seed % 2 else mutate(good))
        labels.append(f"{seed}: {label}")
    audit = fit(run, batches)
    harmed = [label for label, finite in zip(labels, audit.finite, strict=True) if not finite]
    assert not harmed
    audit.assert_sound()
    print(f"{count} mutated scenes: {sum(audit.skipped)} dropped, none harmful")


@pytest.mark.parametrize("overrides", [(), ("model=voxel_merged",)], ids=" ".join)
def test_far_points_of_two_scenes_can_be_numbered(overrides: tuple[str, ...], tmp_path: Path, cache: Path) -> None:
    small_voxels = ["fine", "coarse"] if not overrides else []
    guards = [f"model.{part}.min_footprint=0" for part in small_voxels] or ["model.min_footprint=0"]
    run = tiny_run(tmp_path, cache, *overrides, *guards)
    (good,) = first_batches(run, 1)
    far = SCENES["outliers on both sides"](good)
    audit = fit(run, [beside(far, far), beside(good, far), far])
    audit.assert_sound()
    assert audit.skipped == [False] * 3


def test_mutated_scenes_do_no_harm(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    check_random_scenes(0, 30, tmp_path, cache, monkeypatch)


@pytest.mark.slow
def test_many_mutated_scenes_do_no_harm(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    check_random_scenes(1000, 400, tmp_path, cache, monkeypatch)
