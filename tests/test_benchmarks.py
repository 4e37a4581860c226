"""The benchmark scripts run and write what they say, at sizes that measure nothing."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from vg2gt.runs.checkpoints import read_checkpoint

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
    overrides = ["backend=da3_tiny", "trainer.precision=bf16-mixed"]
    shown = run("stages.py", tmp_path, *sizes, "--training", "--out", str(tmp_path), *overrides)
    assert "second decode" in shown
    assert "AnySplat (paper)" in shown
    (path,) = tmp_path.glob("*-stages-da3_tiny-tiny-cpu.json")
    content = json.loads(path.read_text())
    assert content["precision"] == "bf16-mixed"
    (case,) = content["cases"]
    assert case["rendered_in_training"] == 3
    assert set(case["seconds"]) == {"encode", "decode", "coarse", "decode_again", "fine", "gaussians", "render"}
    assert all(seconds > 0 for seconds in case["seconds"].values())
    assert case["training_step"] > sum(case["seconds"].values()) / 2


def test_every_script_is_in_the_table() -> None:
    scripts = {path.name for path in BENCHMARKS.glob("*.py")} - {"common.py", "stage_clock.py"}
    helpers = {"found_poses.py", "opensplat.py", "photo_sets.py", "render_scene.py"}
    assert set(re.findall(r"`(\w+\.py)`", (BENCHMARKS / "README.md").read_text())) - {"train.py"} == scripts - helpers


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
    others = {"VG²GT w/o coarse", "pixel-aligned", "voxel-merged", "coloured points"}
    assert set(runs) == {"VG²GT", "VG²GT, 2 px"} | others
    assert runs["pixel-aligned"]["0"]["gaussians"] == runs["coloured points"]["0"]["gaussians"] == 8 * 56 * 112
    assert "| pixel-aligned " in (home / "metrics.md").read_text()
    assert (home / "models.png").stat().st_size > 1000
    before = (home / "seed-0" / "vg2gt" / "metrics.json").stat().st_mtime_ns
    run("baselines.py", tmp_path, *arguments)
    assert (home / "seed-0" / "vg2gt" / "metrics.json").stat().st_mtime_ns == before
    start = next((home / "seed-0" / "vg2gt" / "checkpoints").glob("*.ckpt"))
    run("baselines.py", tmp_path, *arguments, "name=begun", f"coarse={start}", "models=vg2gt,wo_coarse")
    begun = tmp_path / "outputs" / "begun"
    assert set(json.loads((begun / "metrics.json").read_text())["runs"]) == {"VG²GT", "VG²GT w/o coarse"}
    kept = read_checkpoint(begun / "coarse.ckpt")["state_dict"]
    assert kept
    assert all(name.startswith("model.coarse.") for name in kept)
    assert (begun / "seed-0" / "vg2gt" / "start.json").is_file()
    assert not (begun / "seed-0" / "wo_coarse" / "start.json").exists()
