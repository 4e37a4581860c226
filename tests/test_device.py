"""The whole on a GPU against the CPU; in Triton's interpreter the same tests run on a CPU, with what a GPU runs."""

import importlib.util
import os
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.reliability.steps import TINY, first_batches
from tests.training_helpers import NARROW, small_config
from vg2gt.evaluation.in_training import evaluate_scene
from vg2gt.kernels import curve_codes, knn
from vg2gt.method import fine, sparse_conv
from vg2gt.method.additions import voxel_normals
from vg2gt.profiling import listening
from vg2gt.reconstruction.pipeline import reconstruct_with
from vg2gt.rendering import renderer, selfcheck
from vg2gt.runs.load import load_model
from vg2gt.training.loop import Run, build, train

if importlib.util.find_spec("triton") is None:
    pytest.skip("needs triton, which has wheels for Linux on x86-64 only", allow_module_level=True)
INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
interpreted = pytest.mark.skipif(not INTERPRETED, reason="runs in test_in_the_interpreter's process")
GPU = pytest.param("cuda", marks=pytest.mark.gpu)
on_devices = pytest.mark.parametrize("device", [pytest.param("cpu", marks=interpreted), GPU])
slowly_on_a_cpu = pytest.mark.parametrize("device", [pytest.param("cpu", marks=[interpreted, pytest.mark.slow]), GPU])
# The paper's model; the interpreter takes a millisecond for an entry of a tile: few of both.
MODEL = ["model=vg2gt", "model.coarse.min_footprint=4", "optimizer=adamw", "model.coarse.ptv3.drop_path=0"]
MODEL += ["data.min_views=2", "data.max_images=4", "data.train_scenes=2", "training.render_views=1"]
SIZES = {"cpu": ((14, 28), 10), "cuda": ((56, 112), 2)}  # of images, and pixels a voxel
WIDTHS = {"cpu": NARROW, "cuda": []}


@pytest.fixture(autouse=True)
def like_a_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is kept of the kernels' check is a test's own; an interpreted CPU's check is of one mode, for its time."""
    monkeypatch.setattr(selfcheck, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)  # a CPU has none
    selfcheck._refusal.cache_clear()
    if INTERPRETED:
        monkeypatch.setattr(selfcheck, "compare", partial(selfcheck.compare, modes=("rasterized",)))


@pytest.fixture
def as_on_a_gpu(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Makes a CPU run what a GPU runs: no compiled passes, and the kernels as ``auto``'s choice once checked."""

    def switch() -> None:
        for module in (knn, fine, voxel_normals):
            monkeypatch.setattr(module, "compilable", lambda *_, **__: False)
        monkeypatch.setattr(sparse_conv, "one_by_one", lambda device: False)
        monkeypatch.setattr(curve_codes, "has_kernel", lambda device: True)

        def automatic(device: torch.device) -> str:
            selfcheck.require_trusted(device)
            return "triton"

        monkeypatch.setattr(renderer, "automatic", automatic)

    return switch


@on_devices
@pytest.mark.parametrize("bits", [3, 12, 21])
def test_hilbert_codes(device: str, bits: int) -> None:
    from vg2gt.kernels.hilbert import hilbert_in_one_kernel

    cells = torch.randint(0, 1 << bits, (700, 3), generator=torch.Generator().manual_seed(bits))
    found = hilbert_in_one_kernel(cells.to(device), bits)
    assert torch.equal(found.cpu(), curve_codes.hilbert_reference(cells, bits))


def sized(device: str) -> list[str]:
    (height, width), pixels = SIZES[device]
    return [*TINY, *MODEL, *WIDTHS[device], f"data.image_size=[{height},{width}]", f"model.fine.min_footprint={pixels}"]


def made(folder: Path, cache: Path, device: str) -> Run:
    return build(small_config(folder, cache, *sized(device)))


def step_of(run: Run, device: str) -> tuple[Tensor, dict[str, Tensor], list[str]]:
    """Loss and gradients of the first step, of two scenes, on the CPU, and the stages that it went through."""
    (batch,) = first_batches(run, 1)
    assert len(batch.scene) == 2
    module, stages = run.module.to(device).train(), []
    module.log = lambda *_, **__: None  # type: ignore[method-assign]
    module.generator.manual_seed(0)

    def note(name: str) -> Any:
        stages.append(name)
        return partial(torch.enable_grad)()

    with listening(note):
        loss = module.training_step(batch.to(torch.device(device)), 0)
    loss.backward()
    grads = {name: p.grad.cpu() for name, p in module.model.named_parameters() if p.grad is not None}
    return loss.detach().cpu(), grads, stages


@slowly_on_a_cpu
def test_a_training_step_of_the_papers_model(device: str, tmp_path: Path, cache: Path, as_on_a_gpu: Any) -> None:
    expected, expected_grads, stages = step_of(made(tmp_path / "cpu", cache, device), "cpu")
    if device == "cpu":
        as_on_a_gpu()
    loss, grads, again = step_of(made(tmp_path / "gpu", cache, device), device)
    assert again == stages
    assert {"coarse", "fine", "gaussians", "render", "loss"} <= set(stages)
    # A point on a cell's face may fall to the other side elsewhere.
    torch.testing.assert_close(loss, expected, rtol=1e-4 if device == "cpu" else 2e-3, atol=0)
    assert grads.keys() == expected_grads.keys()
    together = [torch.cat([each[name].flatten() for name in grads]) for each in (grads, expected_grads)]
    assert (together[0] - together[1]).norm() < (1e-3 if device == "cpu" else 5e-2) * together[1].norm()


@slowly_on_a_cpu
def test_an_evaluation(device: str, tmp_path: Path, cache: Path, as_on_a_gpu: Any) -> None:
    def metrics(where: str) -> dict[str, float]:
        run = made(tmp_path / where, cache, device)
        run.datamodule.setup("validate")
        batch = next(iter(run.datamodule.val_dataloader())).to(torch.device(where))
        with torch.inference_mode():
            return evaluate_scene(run.module.model.eval().to(where), run.module.renderer, batch)

    expected = metrics("cpu")
    if device == "cpu":
        as_on_a_gpu()
    found = metrics(device)
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, rel=1e-2, abs=1e-3), name


@slowly_on_a_cpu
def test_a_reconstruction(device: str, as_on_a_gpu: Any) -> None:
    """Untrained, of random weights, which is as good as any."""
    size, pixels = SIZES[device]

    def scene(where: str) -> tuple[int, Tensor]:
        options = [f"model.fine.min_footprint={pixels}", "model.coarse.min_footprint=4", *WIDTHS[device]]
        ready = load_model(None, "da3_tiny", ["model=vg2gt", *options], where)
        images = torch.rand(3, 3, *size, generator=torch.Generator().manual_seed(0))
        made = reconstruct_with(ready.model, images, size=size, renderer=ready.renderer)
        (view,) = made.render(made.named_cameras()[:1])
        return len(made.gaussians), view.color

    count, color = scene("cpu")
    if device == "cpu":
        as_on_a_gpu()
    found, again = scene(device)
    # On a GPU backbone and networks are bfloat16: depth is rounded by half a percent, and a voxel is a few wide.
    assert abs(found - count) <= (0 if device == "cpu" else 0.1) * count
    assert (again - color).abs().mean() < (1e-5 if device == "cpu" else 5e-2)


@slowly_on_a_cpu
def test_a_run_from_beginning_to_end(device: str, tmp_path: Path, cache: Path, as_on_a_gpu: Any) -> None:
    """``train.py trainer.fast_dev_run=true``; the kernels are checked in its first render, an evaluation."""
    accelerator = "gpu" if device == "cuda" else "cpu"
    options = [*sized(device), "trainer.fast_dev_run=true", f"trainer.accelerator={accelerator}"]
    if device == "cpu":
        as_on_a_gpu()
    else:
        options += ["trainer=gpu"]
    report = train(small_config(tmp_path, cache, *options))
    assert all(value == value for value in report["trained"].values())
    assert (tmp_path / "gpu_agreement.json").is_file()


TWO = pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")


@pytest.mark.gpu
@pytest.mark.parametrize(
    "options",
    [
        ["trainer=gpu"],
        ["trainer=gpu", "experiment=sweep"],
        ["trainer=ddp", "trainer.devices=1"],
        pytest.param(["trainer=ddp", "trainer.devices=2"], marks=TWO),
    ],
    ids=" ".join,
)
def test_the_command(options: list[str], tmp_path: Path, cache: Path) -> None:
    """As typed, with the default model; ``ddp`` communicates by NCCL."""
    places = [f"output_dir={tmp_path}", f"hydra.run.dir={tmp_path}", f"data.cache_dir={cache}"]
    few = ["trainer.max_steps=2", "data.train_scenes=2", "data.eval_scenes=1"]
    command = [sys.executable, "-m", "vg2gt.cli.train", *options, *few, *places]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    ended = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment, timeout=300)
    assert ended.returncode == 0, ended.stderr[-3000:]
    assert (tmp_path / "metrics.json").is_file()
