"""The benchmark scripts run and write what they say, at sizes that measure nothing."""

import json
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch

from tests.commands import run_python
from vg2gt.runs.checkpoints import read_checkpoint, write_checkpoint

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


@pytest.mark.slow
def test_stages_of_the_papers_experiment(tmp_path: Path) -> None:
    """Its settings ask for two devices and bfloat16; measured is one device's share, networks in bfloat16."""
    options = ["--views", "3", "--size", "56", "112", "--passes", "1", "--device", "cpu", "--out", str(tmp_path)]
    small = ["backend=da3_tiny", "data=synthetic", "trainer=gpu", "model=tiny", "training.render_views=null"]
    run("stages.py", tmp_path, *options, "experiment=paper", *small)
    (path,) = tmp_path.glob("*-stages-da3_tiny-tiny-cpu.json")
    assert json.loads(path.read_text())["precision"] == "bf16-mixed"


def test_every_script_is_in_the_table() -> None:
    scripts = {path.name for path in BENCHMARKS.glob("*.py")} - {"common.py", "stage_clock.py"}
    helpers = {"found_poses.py", "opensplat.py", "photo_sets.py", "render_scene.py"}
    assert set(re.findall(r"`(\w+\.py)`", (BENCHMARKS / "README.md").read_text())) - {"train.py"} == scripts - helpers


def test_training_hours_count_every_device(benchmark_script) -> None:
    """The paper: 49.5 hours of two devices, 420000 steps, are 99 device hours."""
    assert benchmark_script("stages").paper_training_hours(49.5 * 3600 / 420_000) == pytest.approx(99)


def test_stages_run_in_the_precision_of_the_training(tmp_path: Path, benchmark_script) -> None:
    stages, device = benchmark_script("stages"), torch.device("cpu")
    overrides = ("trainer.precision=bf16-mixed", f"data.cache_dir={tmp_path}")
    run, batch = stages.prepare(stages.Case(2, (28, 56), overrides), device, str(tmp_path / "run"))
    seen: list[bool] = []
    run.module.model.fine.register_forward_pre_hook(lambda *_: seen.append(torch.is_autocast_enabled("cpu")))
    stages.measure_inference(run, batch, 1, device)
    stages.measure_training(run, batch, 1, device)
    assert seen == 4 * [True]


@pytest.mark.slow
def test_primitives(tmp_path: Path) -> None:
    where = ["--out", str(tmp_path), "--figures", str(tmp_path), "--device", "cpu"]
    run("primitives.py", tmp_path, "--views", "2", "6", "--footprints", "2", "4", *where, TINY[0])
    (path,) = tmp_path.glob("*-primitives-rooms-cpu.json")
    rows = {(row["method"], row["views"]): row["primitives"] for row in json.loads(path.read_text())["rows"]}
    assert rows["pixel-aligned", 6] == 3 * rows["pixel-aligned", 2] == 6 * 56 * 112
    assert rows["VG²GT, 4 px", 6] < 2 * rows["VG²GT, 4 px", 2]
    assert rows["VG²GT, 4 px", 6] < rows["VG²GT, 2 px", 6]


def test_primitives_take_no_weights(tmp_path: Path) -> None:
    """They would be passed over."""
    script = f"import sys; sys.path.insert(0, {str(BENCHMARKS)!r}); import primitives; primitives.main()"
    shown = run_python(script, "init_from=some.ckpt", folder=tmp_path)
    assert shown.returncode != 0
    assert "init_from=some.ckpt: only untrained models are measured here" in shown.stderr


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


@pytest.mark.slow
def test_baselines_on_recordings(tmp_path: Path, shared: Path) -> None:
    data = f"shared={shared / 'data'}"
    run("baselines.py", tmp_path, "name=real", "models=pointcloud", data, "backend=sweep", *TINY, *QUIET)
    home = tmp_path / "outputs" / "real"
    recordings = json.loads((home / "metrics.json").read_text())["recordings"]
    assert set(recordings) == {"HoloLens office", "7-Scenes kitchen"}
    assert recordings["HoloLens office"]["coloured points"]["0"]["gaussians"] == 8 * 112 * 168
    assert "## 7-Scenes kitchen, never trained on" in (home / "metrics.md").read_text()


def test_baselines_name_what_is_not_there(tmp_path: Path) -> None:
    write_checkpoint({"state_dict": {"model.gaussians.x": torch.ones(1)}}, tmp_path / "other.ckpt")
    script = f"import sys; sys.path.insert(0, {str(BENCHMARKS)!r}); import baselines; baselines.main()"
    for argument, message in {
        "models=vg2gt,pixel": "models=vg2gt,pixel: no model pixel; there are vg2gt, vg2gt_fine, wo_coarse",
        "coarse=other.ckpt": "coarse=other.ckpt: this checkpoint has no coarse module",
    }.items():
        shown = run_python(script, argument, folder=tmp_path)
        assert shown.returncode != 0
        assert message in shown.stderr


@pytest.mark.slow
def test_counts(tmp_path: Path) -> None:
    """Sizes at which nothing is learnt; the number of the model without its coarse module follows the other's."""
    arguments = ["steps=1", "name=short", *TINY, *QUIET]
    run("baselines.py", tmp_path, *arguments, "models=vg2gt,pixel_aligned")
    home = tmp_path / "outputs" / "short"
    before = (home / "seed-0" / "vg2gt" / "metrics.json").stat().st_mtime_ns
    assert "## At equal counts" in run("counts.py", tmp_path, *arguments)
    assert (home / "seed-0" / "vg2gt" / "metrics.json").stat().st_mtime_ns == before
    content = json.loads((home / "counts.json").read_text())
    full, _, widened = content["equal"].values()
    assert abs(widened["0"]["gaussians"] / full["0"]["gaussians"] - 1) < 0.05
    assert any(path.name.startswith("wo_coarse-") for path in (home / "seed-0").iterdir())
    curve = {(k, px): metrics["gaussians"] for k, cells in content["curve"].items() for px, metrics in cells.items()}
    assert set(curve) == {
        ("1", "2.02"),
        ("1", "3.1"),
        ("2", "2.02"),
        ("2", "3.1"),
        ("2", "4.5"),
        ("4", "3.1"),
        ("4", "4.5"),
    }
    assert curve["4", "4.5"] > curve["2", "4.5"]
    if find_spec("matplotlib"):  # extra: eval
        assert (home / "counts.png").stat().st_size > 1000


def test_cells_are_found_for_a_number_of_gaussians(benchmark_script) -> None:
    """Numbers that fall as a power of the cell's edge, and ones that nothing changes."""
    counts = benchmark_script("counts")
    edge = counts.footprint_for(20_000, lambda pixels: 300_000 / pixels**1.7, 3.1)
    assert 300_000 / edge**1.7 == pytest.approx(20_000, rel=0.01)
    with pytest.raises(ValueError, match="no edge gives 20000 Gaussians within 1%"):
        counts.footprint_for(20_000, lambda pixels: 50_000.0, 3.1)


@pytest.mark.slow
def test_memory(tmp_path: Path) -> None:
    run("memory.py", tmp_path, "--models", "tiny", "--out", str(tmp_path))
    (written,) = tmp_path.glob("*-memory-cpu.json")
    points = json.loads(written.read_text())["points"]
    views = [point for point in points if point["varied"] == "views"]
    for mode in ("forward", "training"):
        passes = [point[mode]["pass_mib"] for point in views]
        assert passes == sorted(passes)
    assert views[-1]["training"]["pass_mib"] > views[-1]["forward"]["pass_mib"] > 0
    capped = next(point for point in points if point["overrides"] == ["model.fine.max_voxels=1000"])
    assert capped["forward"]["voxels"] == 1000
    assert capped["training"]["pass_mib"] < views[-1]["training"]["pass_mib"]
    lines = written.with_suffix(".md").read_text().splitlines()
    assert [line.split("|")[2].strip() for line in lines if line.startswith("| views ")] == ["2", "4", "8", "16"]


@pytest.mark.slow
def test_refine(tmp_path: Path) -> None:
    where = ["--out", str(tmp_path), "--figures", str(tmp_path), "--device", "cpu", "--scenes", "1", "--seconds", "1"]
    run("refine.py", tmp_path, *where, TINY[0], "data.train_scenes=1", f"data.cache_dir={tmp_path}")
    (path,) = tmp_path.glob("*-refine-rooms-cpu.json")
    curves = json.loads(path.read_text())["curves"]
    assert set(curves) == {"VG²GT, untrained", "pixel-aligned, untrained", "voxel-merged, untrained", "point cloud"}
    for points in curves.values():
        assert points[0]["step"] == 0 < points[-1]["step"]
        assert points[-1]["psnr"] > points[0]["psnr"]
