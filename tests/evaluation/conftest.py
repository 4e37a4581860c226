"""A small scene and a model on it."""

from pathlib import Path
from typing import Any

import pytest
import torch

from tests.training_helpers import small_config
from vg2gt.evaluation.evaluator import EvaluationOptions, SceneEvaluator, SceneResult
from vg2gt.training.loop import build
from vg2gt.training.module import VG2GTModule
from vg2gt.types import Batch


@pytest.fixture(scope="module")
def module_and_batch(tmp_path_factory: pytest.TempPathFactory) -> tuple[VG2GTModule, Batch]:
    """An untrained head on the oracle, and a room of 56x112 with 8 context and 3 target views."""
    folder = tmp_path_factory.mktemp("scene")
    run = build(small_config(folder, folder / "cache", "data.image_size=[56,112]"))
    run.module.eval()
    return run.module, next(iter(run.datamodule.val_dataloader()))


@pytest.fixture(scope="module")
def evaluator(module_and_batch) -> SceneEvaluator:
    module, _ = module_and_batch
    return SceneEvaluator(module.model, module.renderer, EvaluationOptions())


@pytest.fixture(scope="module")
def batch(module_and_batch) -> Batch:
    torch.manual_seed(0)
    return module_and_batch[1]


@pytest.fixture(scope="module")
def result(evaluator: SceneEvaluator, batch: Batch) -> SceneResult:
    return evaluator(batch)


def evaluate_overrides(folder: Path, cache: Path, *overrides: str) -> list[str]:
    """Overrides of ``configs/evaluate.yaml`` for an evaluation of two rooms of 28x56."""
    small = ["data.image_size=[28,56]", "data.eval_scenes=2", "views=[2]", "device=cpu", "name=test"]
    return [*small, f"output_dir={folder}", f"data.cache_dir={cache}", *overrides]


def without_cost(scores: dict[str, Any]) -> dict[str, Any]:
    """Without times and memory."""
    return {name: value for name, value in scores.items() if not name.endswith(("_seconds", "_mib"))}
