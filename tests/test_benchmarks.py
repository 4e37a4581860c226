"""The benchmark scripts run and write what they say, at sizes that measure nothing."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.geometry.test_geodesy import on_earth
from vg2gt.io.files import read_json

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


def test_every_script_is_in_the_table() -> None:
    scripts = {path.name for path in BENCHMARKS.glob("*.py")}
    helpers = {"common.py", "opensplat.py", "photo_sets.py"}
    assert set(re.findall(r"`(\w+\.py)`", (BENCHMARKS / "README.md").read_text())) - {"train.py"} == scripts - helpers


@pytest.mark.parametrize("part", ["render", "reconstruct"])
def test_parts_of_the_gpu_script_run_on_a_cpu(part: str, benchmark_script, tmp_path: Path) -> None:
    gpu = benchmark_script("gpu")
    found = gpu.measure(part, gpu.Setting(torch.device("cpu"), small=True), tmp_path / "part.json")
    assert found["ended"] == "done"
    assert found["results"]
    assert read_json(tmp_path / "part.json") == found


@pytest.mark.slow
def test_the_gpu_script_runs_on_a_cpu(benchmark_script, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    benchmark_script("gpu").main(["--small", "--device", "cpu", "--out", str(tmp_path)])
    printed = capsys.readouterr().out
    assert re.findall(r"^(\w+): done", printed, re.MULTILINE) == list(benchmark_script("gpu").PARTS), printed


def test_halves_by_gps_tell_how_wrong_they_are(benchmark_script) -> None:
    """One half measured 2 % too far apart."""
    flight = np.stack([np.tile(np.arange(6) * 20.0, 4), np.repeat(np.arange(4) * 25.0, 6), 60 + 0 * np.arange(24)], 1)
    half = np.arange(24) % 2 == 0
    compare = benchmark_script("gps").compare
    exact = compare(flight / 7, on_earth(flight), half)
    assert exact["scale"] < 1e-4
    assert exact["error"] < 0.01
    found = compare(flight / 7, on_earth(np.where(half[:, None], 1.02 * flight, flight)), half)
    assert found["scale"] == pytest.approx(0.02, abs=1e-4)
    assert found["error"] > 0.5
    assert found["up"] < 0.01
