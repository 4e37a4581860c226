"""A calibration made of rooms, found again next to its checkpoint, and scored on others."""

import json
import math
from pathlib import Path

import pytest
import torch

from tests.evaluation.conftest import evaluate_overrides
from tests.training_helpers import small_config
from vg2gt.config import compose
from vg2gt.evaluation.calibrate import make_calibration
from vg2gt.evaluation.run import evaluate
from vg2gt.evaluation.scene_metrics import ause, stated_error_metrics
from vg2gt.runs.load import load_model
from vg2gt.training.loop import train
from vg2gt.visibility import Status


def overrides(cache: Path, *more: str) -> list[str]:
    small = ["data.image_size=[28,56]", "data.eval_scenes=6", "data.num_frames=4", "views=[2,3]", "device=cpu"]
    return [*small, f"data.cache_dir={cache}", "data.val.first_seed=2000000", *more]


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory, cache: Path) -> Path:
    folder = tmp_path_factory.mktemp("run") / "outputs" / "tiny"
    train(small_config(folder, cache, "trainer.max_steps=1"))
    make_calibration(compose("calibrate", f"ckpt={folder}", *overrides(cache)))
    return folder


def test_a_checkpoint_brings_its_calibration(calibrated: Path) -> None:
    found = load_model(calibrated, device="cpu").calibration
    assert found is not None
    assert found.scenes == 6
    other = next((calibrated / "checkpoints").glob("*.json"))
    content = json.loads(other.read_text()) | {"made_for": "others"}
    other.write_text(json.dumps(content))
    try:
        assert load_model(calibrated, device="cpu").calibration is None
    finally:
        other.write_text(json.dumps(content | {"made_for": found.made_for}))


def test_an_evaluation_scores_it(calibrated: Path, cache: Path, tmp_path: Path) -> None:
    report = evaluate(compose("evaluate", *evaluate_overrides(tmp_path, cache, f"ckpt={calibrated}")))
    mean = report["views"]["2"]["mean"]
    held = [mean[f"stated/held_{level}"] for level in (50, 80, 90, 95)]
    assert held == sorted(held)
    assert held[2] == pytest.approx(0.9, abs=0.08)  # two rooms of 28x56
    assert 0 < mean["stated/width_50"] < mean["stated/width_95"]
    assert 0 < mean["stated/held_90_agreed"] <= 1
    assert "## Stated errors of the decoded depth" in (tmp_path / "metrics.md").read_text()


def test_it_needs_a_place_and_enough_scenes(cache: Path) -> None:
    with pytest.raises(ValueError, match=r"give out=FILE\.json"):
        make_calibration(compose("calibrate", *overrides(cache)))
    few = ["data.eval_scenes=2", "backend=oracle", "model=tiny", "out=nowhere.json"]
    with pytest.raises(ValueError, match="2 scenes"):
        make_calibration(compose("calibrate", *overrides(cache, *few)))


def test_coverage_width_and_order() -> None:
    error = torch.tensor([0.01, 0.02, 0.03, 0.04])
    bounds = torch.tensor([[0.02] * 4, [0.02] * 4, [0.02, 0.01, 0.05, 0.05], [0.05] * 4])
    status = torch.tensor([Status.AGREED, Status.AGREED, Status.SINGLE, Status.AGREED])
    found = stated_error_metrics(error, bounds, status)
    assert (found["held_50"], found["held_90"]) == (0.5, 0.75)
    assert (found["held_90_agreed"], found["held_90_single"]) == (pytest.approx(2 / 3), 1)
    assert math.isnan(found["held_90_contradicted"])
    assert found["width_90"] == pytest.approx(0.02)
    assert math.isnan(
        stated_error_metrics(torch.zeros(0), torch.zeros(4, 0), torch.zeros(0))["ause"]
    )  # nothing to score
    error = torch.rand(1000, generator=torch.Generator().manual_seed(0))
    assert ause(error, 3 * error) == pytest.approx(0, abs=1e-9)
    shuffled = ause(error, torch.rand(1000, generator=torch.Generator().manual_seed(1)))
    assert 0.2 < shuffled < ause(error, -error)
    # Uniform errors left out at random keep their mean, left out by size the largest goes down: 1 - (1 - mean(share)).
    assert shuffled == pytest.approx(0.475, abs=0.05)
