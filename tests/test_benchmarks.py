"""The benchmark scripts run and write what they say, at sizes that measure nothing."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
TINY = ["data.image_size=[56,112]", "data.train_scenes=1", "data.eval_scenes=1"]
QUIET = ["trainer.enable_progress_bar=false", "callbacks.progress_bar=null"]


def run(name: str, folder: Path, *arguments: str) -> str:
    command = [sys.executable, str(BENCHMARKS / name), *arguments]
    shown = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=500)
    assert shown.returncode == 0, shown.stderr[-3000:]
    return shown.stdout


@pytest.mark.slow
def test_stages(tmp_path: Path) -> None:
    sizes = ["--views", "3", "--size", "56", "112", "--passes", "1", "--device", "cpu"]
    shown = run("stages.py", tmp_path, *sizes, "--training", "--out", str(tmp_path), "backend=da3_tiny")
    assert "second decode" in shown
    assert "AnySplat (paper)" in shown
    (path,) = tmp_path.glob("*-stages-cpu.json")
    (case,) = json.loads(path.read_text())["cases"]
    assert set(case["seconds"]) == {"encode", "decode", "coarse", "decode_again", "fine", "gaussians", "render"}
    assert all(seconds > 0 for seconds in case["seconds"].values())
    assert case["training_step"] > sum(case["seconds"].values()) / 2


@pytest.mark.slow
def test_primitives(tmp_path: Path) -> None:
    where = ["--out", str(tmp_path), "--figures", str(tmp_path), "--device", "cpu"]
    run("primitives.py", tmp_path, "--views", "2", "6", "--footprints", "2", "4", *where, TINY[0])
    (path,) = tmp_path.glob("*-primitives-rooms-cpu.json")
    rows = {(row["method"], row["views"]): row["primitives"] for row in json.loads(path.read_text())["rows"]}
    assert rows["pixel-aligned", 6] == 3 * rows["pixel-aligned", 2] == 6 * 56 * 112
    assert rows["VG²GT, 4 px", 6] < 2 * rows["VG²GT, 4 px", 2]
    assert rows["VG²GT, 4 px", 6] < rows["VG²GT, 2 px", 6]


@pytest.mark.slow
def test_baselines(tmp_path: Path) -> None:
    arguments = ["steps=1", "name=short", *TINY, *QUIET]
    run("baselines.py", tmp_path, *arguments)
    home = tmp_path / "outputs" / "short"
    runs = json.loads((home / "metrics.json").read_text())["runs"]
    assert set(runs) == {"VG²GT", "VG²GT w/o coarse", "pixel-aligned", "voxel-merged", "coloured points"}
    assert runs["pixel-aligned"]["0"]["gaussians"] == runs["coloured points"]["0"]["gaussians"] == 8 * 56 * 112
    assert "| pixel-aligned |" in (home / "metrics.md").read_text()
    assert (home / "models.png").stat().st_size > 1000
    before = (home / "seed-0" / "vg2gt" / "metrics.json").stat().st_mtime_ns
    run("baselines.py", tmp_path, *arguments)
    assert (home / "seed-0" / "vg2gt" / "metrics.json").stat().st_mtime_ns == before
