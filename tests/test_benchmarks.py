"""The benchmark scripts run and write what they say, at sizes that measure nothing."""

import re
from pathlib import Path

import pytest
import torch

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
