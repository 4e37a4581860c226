"""Measurements on a GPU, in about eight minutes: ``python benchmarks/gpu.py [--parts NAME ...]``.

Parts: forward and backward pass of the renderer (``render``), training steps of ``experiment=paper`` with random
weights, by stage, with plain and compiled transformer blocks, and the device hours of a training of the paper's length
(``step``), trainings on the same scenes with one GPU and all (``ddp``), ``reconstruct`` with 50 images
(``reconstruct``), and ``pytest -m gpu`` (``tests``).
After every measurement it writes ``<date>-gpu-<part>.json`` to ``--out`` (default: the variable OUT, or
benchmarks/results), so that partial results are kept. ``--small`` makes all sizes tiny, also for a CPU.
"""

from __future__ import annotations

import csv
import gc
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from common import MEGABYTE, RESULTS, dated, machine, parser, prepare, whole_step
from render import Case, compare
from torch.profiler import profile

from vg2gt.io.files import write_json
from vg2gt.profiling import listening, now, reset_peak_memory
from vg2gt.reconstruction.pipeline import reconstruct_with
from vg2gt.runs.load import load_model

ROOT = Path(__file__).resolve().parents[1]
Result = dict[str, Any]
LINES = 25  # lines of output and profile to keep
PAPER_STEPS, PAPER_DEVICES = 420_000, 2
COMPILED = "training.compile_blocks=true"
DDP_STEPS = (10, 30)  # lengths of two trainings, whose difference is without start and evaluations


@dataclass(frozen=True)
class Setting:
    """Device and size of the measurements.

    Attributes:
        device: a GPU or a CPU.
        small: whether to use tiny sizes, for testing only.
    """

    device: torch.device
    small: bool

    def peak_mb(self) -> float:
        """Returns peak memory allocated on the GPU since :meth:`forget_peak`, in MB; 0 on a CPU."""
        return torch.cuda.max_memory_allocated(self.device) / MEGABYTE if self.device.type == "cuda" else 0.0

    def forget_peak(self) -> None:
        """Frees the memory of earlier measurements, and resets peak memory."""
        gc.collect()
        torch.cuda.empty_cache()
        reset_peak_memory(self.device)


def render(setting: Setting) -> Iterator[Result]:
    """Forward and backward pass of 8 views of 224x448 by mode and number of Gaussians."""
    ours = "triton" if setting.device.type == "cuda" else "cpu"
    size, views, passes = ((16, 32), 1, 1) if setting.small else ((224, 448), 8, 5)
    for count in (500,) if setting.small else (100_000, 1_000_000):
        cases = [Case(ours, count, size, views, mode) for mode in ("solid", "rasterized")]
        for case, timing in zip(cases, compare(cases, setting.device, passes), strict=True):
            found = {"forward_ms": timing.forward, "backward_ms": timing.backward, "peak_mb": timing.memory}
            yield {f"{ours} {case.mode} {count}": found}


def step(setting: Setting) -> Iterator[Result]:
    """Training steps of the paper's experiment: time, memory, stages and profile."""
    if setting.small:
        tiny = ("backend=da3_tiny", "model=tiny", "trainer.precision=bf16-mixed")
        cases = {"tiny": (2, (28, 56), tiny), "tiny, compiled blocks": (2, (28, 56), (*tiny, COMPILED))}
    else:
        # measure even if the self-check rejects the kernels
        random = ("backend.pretrained=false", "renderer.implementation=triton")
        large = (8, (224, 448), (*random, "backend=da3_large"))
        giant = (15, (224, 448), (*random, "backend=da3_giant"))
        cases = {
            "da3_large, 8 views": large,
            "da3_giant, 15 views": giant,
            "da3_giant, 15 views, trained too": (*giant[:2], (*giant[2], "backend.freeze=false")),
            "da3_large, 8 views, compiled blocks": (*large[:2], (*large[2], COMPILED)),
            "da3_giant, 15 views, compiled blocks": (*giant[:2], (*giant[2], COMPILED)),
        }
    for name, (views, size, overrides) in cases.items():
        for found in _step(setting, views, size, ("experiment=paper", "trainer=gpu", "data=synthetic", *overrides)):
            yield {f"{name}: {what}": value for what, value in found.items()}


def _step(setting: Setting, views: int, size: tuple[int, int], overrides: Sequence[str]) -> Iterator[Result]:
    device = setting.device
    setting.forget_peak()
    with tempfile.TemporaryDirectory() as folder:
        run, batch = prepare(views, size, overrides, device, Path(folder))
    stages: dict[str, float] = {}

    @contextmanager
    def stage(name: str) -> Iterator[None]:
        begin = now(device)
        yield
        stages[name] = stages.get(name, 0.0) + 1e3 * (now(device) - begin)

    whole = partial(whole_step(run, stage), batch.context)
    taken = []
    for _ in range(2 if setting.small else 4):
        begin = now(device)
        whole()
        taken.append(1e3 * (now(device) - begin))
    milliseconds = min(taken[1:])  # the first is a warm-up
    reserved = torch.cuda.max_memory_reserved(device) / MEGABYTE if device.type == "cuda" else 0.0
    hours = milliseconds / 3.6e6 * PAPER_STEPS * PAPER_DEVICES
    memory = {"peak_mb": setting.peak_mb(), "peak_reserved_mb": reserved}
    yield {"step": {"ms": milliseconds, "device_hours_of_the_paper": hours, **memory}}
    stages.clear()
    with listening(stage):
        whole()
    yield {"stage_ms": stages}
    with profile() as found:
        whole()
    kind = "self_device_time_total" if device.type == "cuda" else "self_cpu_time_total"
    yield {"profile": found.key_averages().table(sort_by=kind, row_limit=LINES).splitlines()}


def ddp(setting: Setting) -> Iterator[Result]:
    """Trainings on one device and on all, with as many scenes per step: time per step, and how far losses differ.

    The first steps have equal weights up to the order of sums; later ones also differ by what rounding has grown to.
    """
    count = 2 if setting.small else torch.cuda.device_count()
    if count < 2:
        yield {"skipped": "needs several GPUs"}
        return
    curves = []
    for devices in (1, count):
        seconds, curve = zip(*(_train(setting, devices, count, steps) for steps in DDP_STEPS), strict=True)
        curves.append(curve[-1])
        milliseconds = 1e3 * (seconds[1] - seconds[0]) / (DDP_STEPS[1] - DDP_STEPS[0])
        yield {f"{devices} devices, {count} scenes": {"ms": milliseconds, "losses": curve[-1]}}
    apart = [abs(one - several) / abs(one) for one, several in zip(*curves, strict=True)]
    yield {"relative difference of the losses": apart}


def _train(setting: Setting, devices: int, scenes: int, steps: int) -> tuple[float, list[float]]:
    """Seconds and losses of ``train.py experiment=paper`` with that many scenes per step, over all devices."""
    views, size = (2, "[28,56]") if setting.small else (8, "[224,448]")
    tiny = ["backend=da3_tiny", "model=tiny", "trainer.accelerator=cpu"]
    overrides = tiny if setting.small else ["backend=da3_large", "backend.pretrained=false"]
    overrides += [f"data.image_size={size}", f"data.min_views={views}", f"data.max_views={views}"]
    overrides += [f"data.max_images={views * scenes // devices}", f"data.train_scenes={2 * scenes}"]
    overrides += ["data.eval_scenes=1", "model.coarse.ptv3.drop_path=0", "optimizer.lr=1e-5", "training.final_lr=1e-5"]
    overrides += [f"trainer.devices={devices}", f"trainer.max_steps={steps}", "++trainer.log_every_n_steps=1"]
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, str(ROOT / "train.py"), "experiment=paper", "data=synthetic", *overrides]
        begin = time.monotonic()
        ended = subprocess.run(
            [*command, f"output_dir={folder}"], cwd=ROOT, capture_output=True, text=True, check=False
        )
        seconds = time.monotonic() - begin
        if ended.returncode:
            raise RuntimeError(f"train.py ended with status {ended.returncode}: {ended.stderr[-1000:]}")
        (path,) = Path(folder).glob("logs/*/metrics.csv")
        with path.open() as file:
            return seconds, [float(row["loss"]) for row in csv.DictReader(file) if row["loss"]]


def reconstruct(setting: Setting) -> Iterator[Result]:
    """Reconstruction of 10 and 50 images with the paper's model and random weights, and rendering of all views."""
    backend, model, size = ("da3_tiny", "tiny", (28, 56)) if setting.small else ("da3_large", "vg2gt", (224, 448))
    ready = load_model(None, backend, ["backend.pretrained=false", f"model={model}"], str(setting.device))
    implementation = "triton" if setting.device.type == "cuda" else "auto"  # even if the self-check rejects it
    renderer = replace(ready.renderer, implementation=implementation)
    for count in (2,) if setting.small else (10, 50):
        generator = torch.Generator().manual_seed(0)
        small = torch.rand(count, 3, size[0] // 7, size[1] // 7, generator=generator)
        images = torch.nn.functional.interpolate(small, size=size, mode="bilinear")
        setting.forget_peak()
        begin = now(setting.device)
        scene = reconstruct_with(ready.model, images, size=size, renderer=renderer)
        taken = now(setting.device) - begin
        found = {"seconds": taken, "peak_mb": setting.peak_mb(), "gaussians": len(scene.gaussians)}
        setting.forget_peak()
        begin = now(setting.device)
        for _ in scene.render():
            pass
        rendered = {"render_seconds": now(setting.device) - begin, "render_peak_mb": setting.peak_mb()}
        yield {f"{count} images": found | rendered}


def tests(setting: Setting) -> Iterator[Result]:
    """GPU tests of the test suite; with ``small``, they are only collected."""
    files = [str(path) for path in sorted((ROOT / "tests").rglob("test_*.py")) if "mark.gpu" in path.read_text()]
    options = ["-o", "addopts=", "--import-mode=importlib", "-p", "no:cacheprovider", "-q", "-m", "gpu and not slow"]
    options += ["--continue-on-collection-errors"]  # some files need packages that may be missing
    options += ["--collect-only"] if setting.small else ["--durations=5", "--tb=short"]
    command = [sys.executable, "-m", "pytest", *options, *files]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    shown = ended.stdout.strip().splitlines() or [ended.stderr.strip()[-500:]]
    yield {"status": ended.returncode, "summary": shown[-1], "shown": shown[-4 * LINES :]}
    if ended.returncode:
        raise RuntimeError(f"pytest ended with status {ended.returncode}: {shown[-1]}")


PARTS: dict[str, Callable[[Setting], Iterator[Result]]] = {
    "render": render,
    "step": step,
    "ddp": ddp,
    "reconstruct": reconstruct,
    "tests": tests,
}


def measure(name: str, setting: Setting, path: Path, end: float = float("inf")) -> Result:
    """Measures a part until a time of ``time.monotonic``; writes after every measurement, and also records errors."""
    content: Result = {"machine": machine(), "ended": "out of time", "results": {}}
    begin, found = time.monotonic(), PARTS[name](setting)
    while content["ended"] == "out of time" and time.monotonic() < end:
        try:
            content["results"] |= next(found)
        except StopIteration:
            content["ended"] = "done"
        except Exception as error:  # keep all results so far
            content["ended"] = f"{type(error).__name__}: {' '.join(str(error).split())[:1000]}"
        content["seconds"] = time.monotonic() - begin
        write_json(path, content)
    return content


def main(argv: Sequence[str] | None = None) -> None:
    """Measures and writes; prints how every part ended."""
    options = parser(__doc__, out=Path(os.environ.get("OUT") or RESULTS))
    options.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    options.add_argument("--parts", nargs="+", choices=list(PARTS), default=list(PARTS), metavar="NAME")
    options.add_argument("--small", action="store_true", help="tiny sizes")
    options.add_argument("--minutes", type=float, default=8, help="start no measurement after these minutes")
    arguments = options.parse_args(argv)
    if arguments.device == "cpu" and not arguments.small:
        sys.exit("benchmarks/gpu.py needs a GPU that torch can use, or --small, which measures nothing")
    setting = Setting(torch.device(arguments.device), arguments.small)
    end = time.monotonic() + 60 * arguments.minutes
    for name in arguments.parts:
        found = measure(name, setting, dated(arguments.out, f"gpu-{name}"), end)
        print(f"{name}: {found['ended']}", flush=True)
        for what, value in found["results"].items():
            print(f"  {what}: {str(value)[:200]}", flush=True)


if __name__ == "__main__":
    main()
