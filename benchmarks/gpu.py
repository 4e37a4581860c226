"""All measurements on a GPU, in at most eight minutes: ``python benchmarks/gpu.py [--parts NAME ...]``.

Parts, in order of importance: agreement of the kernels with the reference (``selfcheck``), ``pytest -m gpu``
(``tests``), forward and backward pass of the renderer, and of gsplat if installed (``render``), training steps of
``experiment=paper`` with random weights, by stage, and the device hours of a training of the paper's length (``step``),
``reconstruct`` with 50 images (``reconstruct``), and reading images (``loading``, on the CPU). Every part runs in a
separate process with a time limit. After every measurement it writes ``<date>-gpu-<part>.json`` to ``--out`` (default:
the variable OUT, or benchmarks/results), so that partial results are kept. ``--small`` makes all sizes tiny, also for a
CPU.
"""

from __future__ import annotations

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
from common import MEGABYTE, dated, machine, parser, prepare, whole_step

from vg2gt.io.files import read_json, write_json
from vg2gt.profiling import listening, now

ROOT = Path(__file__).resolve().parents[1]
Result = dict[str, Any]
LINES = 25  # lines of output and profile to keep
PAPER_STEPS, PAPER_DEVICES = 420_000, 2


@dataclass(frozen=True)
class Setting:
    """Device and size of the measurements.

    Attributes:
        device: a GPU or a CPU.
        small: whether to use tiny sizes, for testing only.
    """

    device: torch.device
    small: bool

    def timed(self, run: Callable[[], Any], passes: int = 3) -> float:
        """Returns the milliseconds of the fastest pass, after a warm-up."""
        run()
        taken = []
        for _ in range(1 if self.small else passes):
            begin = now(self.device)
            run()
            taken.append(1e3 * (now(self.device) - begin))
        return min(taken)

    def peak_mb(self) -> float:
        """Returns peak memory allocated on the GPU since :meth:`forget_peak`, in MB; 0 on a CPU."""
        return torch.cuda.max_memory_allocated(self.device) / MEGABYTE if self.device.type == "cuda" else 0.0

    def forget_peak(self) -> None:
        """Resets peak memory, and frees cached memory of earlier measurements."""
        if self.device.type == "cuda":
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats(self.device)


def selfcheck(setting: Setting) -> Iterator[Result]:
    """Differences of the kernels to the reference, and time to compile and check them."""
    from vg2gt.rendering.selfcheck import MODES, compare, identity

    yield {"identity": identity(setting.device)}
    for mode in MODES[1:] if setting.small else MODES:
        begin = time.perf_counter()
        found = compare(setting.device, (mode,))
        seconds = time.perf_counter() - begin
        yield {mode: {"values": found.values, "gradients": found.gradients, "good": found.good, "seconds": seconds}}


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


def render(setting: Setting) -> Iterator[Result]:
    """Forward and backward pass of 8 views of 224x448, alternately with gsplat (which renders expected depth)."""
    from importlib.util import find_spec

    from render import Case, compare

    ours = "triton" if setting.device.type == "cuda" else "cpu"
    names = (ours, "gsplat") if setting.device.type == "cuda" and find_spec("gsplat") else (ours,)
    size, views = ((16, 32), 1) if setting.small else ((224, 448), 8)
    for count in (500,) if setting.small else (100_000, 1_000_000):
        cases = [Case(name, count, size=size, views=views) for name in names]
        cases.append(Case(ours, count, size=size, views=views, mode="rasterized"))
        for case, timing in zip(cases, compare(cases, setting.device, 1 if setting.small else 5), strict=True):
            yield {
                f"{case.implementation} {case.mode} {count}": {
                    "forward_ms": timing.forward,
                    "backward_ms": timing.backward,
                    "peak_mb": timing.memory,
                }
            }


def step(setting: Setting) -> Iterator[Result]:
    """Training steps of the paper's experiment: time, memory, stages and profile."""
    if setting.small:
        tiny = ("backend=da3_tiny", "model=tiny", "trainer.precision=bf16-mixed")
        cases = {"tiny": (2, (28, 56), tiny)}
    else:
        # measure even if the self-check rejects the kernels
        random = ("backend.pretrained=false", "renderer.implementation=triton")
        giant = (15, (224, 448), (*random, "backend=da3_giant"))
        cases = {
            "da3_large, 8 views": (8, (224, 448), (*random, "backend=da3_large")),
            "da3_giant, 15 views": giant,
            "da3_giant, 15 views, trained too": (*giant[:2], (*giant[2], "backend.freeze=false")),
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
    milliseconds = setting.timed(whole)
    reserved = torch.cuda.max_memory_reserved(device) / MEGABYTE if device.type == "cuda" else 0.0
    hours = milliseconds / 3.6e6 * PAPER_STEPS * PAPER_DEVICES
    memory = {"peak_mb": setting.peak_mb(), "peak_reserved_mb": reserved}
    yield {"step": {"ms": milliseconds, "device_hours_of_the_paper": hours, **memory}}
    stages.clear()
    with listening(stage):
        whole()
    yield {"stage_ms": stages}
    yield {"profile": _profile(device, whole)}


def _profile(device: torch.device, act: Callable[[], Any]) -> Result:
    """Number and time of operations (CPU) or kernels (GPU) in one pass, and the slowest of them."""
    from torch.profiler import ProfilerActivity, profile

    on_gpu = device.type == "cuda"
    activities = [ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if on_gpu else [])]
    begin = now(device)
    with profile(activities=activities) as found:
        act()
        wall = 1e3 * (now(device) - begin)
    rows = found.key_averages()
    of_device = [row for row in rows if str(row.device_type).endswith("CUDA")] if on_gpu else list(rows)
    of_device = [row for row in of_device if not row.key.startswith(("vg2gt/", "Optimizer."))]  # enclosing ranges

    def taken(row: Any) -> float:
        return (row.self_device_time_total if on_gpu else row.self_cpu_time_total) / 1e3

    waits = {row.key: row.count for row in rows if "Synchronize" in row.key or row.key == "aten::_local_scalar_dense"}
    return {
        "wall_ms": wall,
        "busy_ms": sum(map(taken, of_device)),
        "launches": sum(row.count for row in of_device),
        "waits": waits,
        "most": [[row.key[:90], row.count, taken(row)] for row in sorted(of_device, key=taken)[: -LINES - 1 : -1]],
    }


def reconstruct(setting: Setting) -> Iterator[Result]:
    """Reconstruction of 10 and 50 images with the paper's model and random weights, and rendering of all views."""
    from vg2gt.reconstruction.pipeline import reconstruct_with
    from vg2gt.runs.load import load_model

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


def loading(setting: Setting) -> Iterator[Result]:
    """Images per second that one core reads, decodes and resizes: RGB-D frames of 480x640 to 224x448."""
    from hydra.utils import instantiate

    from vg2gt.config import compose

    sys.path.insert(0, str(ROOT))
    from examples.write_recordings import write_recording

    drawn, size, steps = ((48, 64), (28, 56), 2) if setting.small else ((480, 640), (224, 448), 20)
    with tempfile.TemporaryDirectory() as folder:
        frames = 24
        made = compose("train", "data=synthetic", f"data.image_size={list(drawn)}", f"data.num_frames={frames}")
        source = instantiate(made.data).train_source()
        write_recording(Path(folder) / "room", source.load(source.scenes[0], source.frames(source.scenes[0])))
        read = ("experiment=paper", "data=rgbd", f"data.root={folder}", f"data.image_size={list(size)}")
        data = instantiate(compose("train", *read, "data.workers=0", "data.memory_mb=0").data)
        data.setup("fit")
        batches, images, begin = iter(data.train_dataloader()), 0, 0.0
        for step in range(steps):
            if step == 1:  # the first batch starts the readers
                images, begin = 0, time.process_time()
            images += next(batches).context.images[..., 0, 0, 0].numel()
        yield {"rgbd": {"images_per_core_second": images / (time.process_time() - begin), "images": images}}


PARTS: dict[str, tuple[Callable[[Setting], Iterator[Result]], int]] = {
    "selfcheck": (selfcheck, 90),
    "tests": (tests, 210),
    "render": (render, 90),
    "step": (step, 180),
    "reconstruct": (reconstruct, 75),
    "loading": (loading, 30),
}
"""Measurements, and their time limits in seconds."""


def measure(name: str, setting: Setting, path: Path) -> Result:
    """Runs a part in this process; writes results after every measurement and also records errors."""
    content: Result = {"machine": machine(setting.device), "ended": "stopped", "results": {}}
    write_json(path, content)
    begin = time.perf_counter()
    try:
        for found in PARTS[name][0](setting):
            content["results"] |= found
            content["seconds"] = time.perf_counter() - begin
            write_json(path, content)
        content["ended"] = "done"
    except Exception as error:  # keep all results so far
        content["ended"] = f"{type(error).__name__}: {' '.join(str(error).split())[:1000]}"
    content["seconds"] = time.perf_counter() - begin
    write_json(path, content)
    return content


def measure_apart(name: str, arguments: Any, seconds: float) -> str:
    """Runs a part in a separate process; returns how it ended."""
    path = dated(arguments.out, f"gpu-{name}")
    command = [sys.executable, __file__, "--here", name, "--device", arguments.device, "--out", str(arguments.out)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(ROOT), os.environ.get("PYTHONPATH", "")))}
    if arguments.device == "cpu":
        environment["TRITON_INTERPRET"] = "1"
    try:
        done = subprocess.run(
            [*command, *(["--small"] if arguments.small else [])],
            env=environment, capture_output=True, text=True, check=False, timeout=seconds,
        )  # fmt: skip
        ended = "" if done.returncode == 0 else f"status {done.returncode}: {done.stderr.strip()[-1000:]}"
    except subprocess.TimeoutExpired:
        ended = f"stopped after {seconds:.0f} s"
    if ended and path.is_file():
        write_json(path, {**read_json(path), "ended": ended})
    return ended or str(read_json(path)["ended"])


def brief(value: Any) -> str:
    """Formats a result in a few words."""
    if isinstance(value, dict):
        return ", ".join(f"{key} {brief(item)}" for key, item in value.items() if not isinstance(item, (dict, list)))
    return f"{value:.4g}" if isinstance(value, float) else str(value)[:160]


def main(argv: Sequence[str] | None = None) -> None:
    """Measures and writes; prints a few lines per part."""
    options = parser(__doc__, out=Path(os.environ.get("OUT") or ROOT / "benchmarks" / "results"), device=True)
    options.add_argument("--parts", nargs="+", choices=list(PARTS), default=list(PARTS), metavar="NAME")
    options.add_argument("--small", action="store_true", help="tiny sizes")
    options.add_argument("--minutes", type=float, default=8, help="time limit for all parts, in minutes")
    options.add_argument("--here", choices=list(PARTS), help="run this part in this process")
    arguments = options.parse_args(argv)
    if arguments.device == "cpu" and not arguments.small:
        sys.exit("benchmarks/gpu.py needs a GPU that torch can use, or --small, which measures nothing")
    if arguments.here:
        setting = Setting(torch.device(arguments.device), arguments.small)
        measure(arguments.here, setting, dated(arguments.out, f"gpu-{arguments.here}"))
        return
    end = time.monotonic() + 60 * arguments.minutes
    for name in arguments.parts:
        left = min(PARTS[name][1], end - time.monotonic())
        if left < 10:
            print(f"{name}: no time left", flush=True)
            continue
        begin = time.monotonic()
        ended = measure_apart(name, arguments, left)
        print(f"{name}: {ended} ({time.monotonic() - begin:.0f} s)", flush=True)
        path = dated(arguments.out, f"gpu-{name}")
        for what, value in (read_json(path)["results"] if path.is_file() else {}).items():
            if not isinstance(value, list):
                print(f"  {what}: {brief(value)}", flush=True)


if __name__ == "__main__":
    main()
