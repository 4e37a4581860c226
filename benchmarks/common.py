"""Shared code of the benchmarks: options, machine info, clocks, peak memory, training steps, result files."""

from __future__ import annotations

import argparse
import ctypes
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from datetime import date
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from torch import Tensor

from vg2gt.config import compose
from vg2gt.io.files import write_json
from vg2gt.training.loop import Run
from vg2gt.training.schedule import parameter_groups
from vg2gt.types import Batch

# Real scenes that no model here was trained on, with the evaluation protocol of trainings: 8 input views, given poses.
RECORDINGS = {
    "HoloLens office": "data=rgbd data.root={shared}/hololens_office_a data.image_size=[112,168]",
    "7-Scenes kitchen": "data=rgbd data.root={shared}/seven_scenes_redkitchen_a_registered data.image_size=[112,168]"
    " data.eval_window=19",
}
RESULTS = Path(__file__).resolve().parent / "results"
MEGABYTE = 1e6


def parser(
    doc: str | None,
    *,
    out: Path = RESULTS,
    device: bool = False,
    threads: int | None = None,
    passes: int | None = None,
    overrides: str | None = None,
) -> argparse.ArgumentParser:
    """Returns a parser with the options that the benchmarks share.

    Args:
        doc: docstring of the script.
        out: default of ``--out``, the folder of results.
        device: whether to add ``--device``, which defaults to the GPU if there is one.
        threads: default of ``--threads``; None adds no such option.
        passes: default of ``--passes``; None adds no such option.
        overrides: help text of Hydra overrides as positional arguments; None adds none.
    """
    made = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--out", type=Path, default=out)
    if device:
        made.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    for name, default in (("--threads", threads), ("--passes", passes)):
        if default is not None:
            made.add_argument(name, type=int, default=default)
    if overrides is not None:
        made.add_argument("overrides", nargs="*", help=overrides)
    return made


def settings(doc: str | None, defaults: Mapping[str, str]) -> tuple[dict[str, str], list[str]]:
    """Splits the command line into the script's own ``key=value`` options, over ``defaults``, and Hydra overrides.

    Raises:
        SystemExit: after printing ``doc``, with ``-h`` or ``--help``.
    """
    own, overrides = dict(defaults), []
    for argument in sys.argv[1:]:
        key, _, value = argument.partition("=")
        if key in ("-h", "--help"):
            print(doc)
            raise SystemExit(0)
        if key in own:
            own[key] = value
        else:
            overrides.append(argument)
    return own, overrides


def dated(folder: Path, name: str) -> Path:
    """Returns today's result file for a name."""
    return folder / f"{date.today().isoformat()}-{name}.json"


def evaluation_scenes(overrides: str) -> Iterator[Batch]:
    """Yields the evaluation scenes, or windows of a recording, of a data configuration."""
    data = instantiate(compose("train", *overrides.split()).data)
    data.setup("validate")
    yield from data.val_dataloader()


def write_results(folder: Path, name: str, content: Mapping[str, Any]) -> Path:
    """Writes ``<date>-<name>.json``; prints and returns its path."""
    path = write_json(dated(folder, name), dict(content))
    print(path)
    return path


def machine(device: torch.device | str = "cpu") -> dict[str, Any]:
    """Returns processor, cores and versions, and the name of the GPU if ``device`` is one."""
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        models = [line.split(":")[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
        name = models[0] if models else name
    found = {
        "processor": name,
        "cores": os.cpu_count(),
        "torch": torch.__version__,
        "python": platform.python_version(),
    }
    if torch.device(device).type == "cuda":
        found["gpu"] = torch.cuda.get_device_name(device)
    return found


def used_seconds(device: torch.device) -> float:
    """Returns CPU time of all cores, which other processes hardly affect; on a GPU, wall time after synchronising."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
        return time.perf_counter()
    return time.process_time()


class PeakMemory:
    """Peak memory since ``restart``: allocated memory on a GPU, resident set (VmHWM) of the process on a CPU.

    Attributes:
        start: bytes in use at construction.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        if device.type == "cuda":
            torch.cuda.empty_cache()
            self.start = torch.cuda.memory_allocated(device)
        else:
            # Return freed memory to the system, otherwise later allocations would reuse it unnoticed.
            ctypes.CDLL(None).malloc_trim(0)
            self.start = status("VmRSS")
        self.restart()

    def restart(self) -> None:
        """Resets the peak."""
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)
        else:
            Path("/proc/self/clear_refs").write_text("5")  # resets VmHWM to the current resident set

    @property
    def peak(self) -> int:
        """Peak memory in bytes."""
        return torch.cuda.max_memory_allocated(self.device) if self.device.type == "cuda" else status("VmHWM")

    @property
    def megabytes(self) -> float:
        """Peak minus start, in MB."""
        return (self.peak - self.start) / MEGABYTE


def status(name: str) -> int:
    """Returns an entry of ``/proc/self/status`` in bytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{name}:"))


def training_step(run: Run) -> Callable[[Batch], Tensor]:
    """Returns the run's training step as a function from batch to loss, without trainer loop and logging."""
    module = run.module.train()
    run.trainer.strategy.connect(module)
    module.trainer = run.trainer
    module.log = lambda *args, **kwargs: None  # type: ignore[method-assign]
    return lambda batch: module.training_step(batch, 0)


def whole_step(
    run: Run, stage: Callable[[str], AbstractContextManager[Any]] = nullcontext
) -> Callable[[Batch], Tensor]:
    """:func:`training_step` with backward pass, clipping and optimiser, which are marked by ``stage``."""
    step_loss, module = training_step(run), run.module
    optimizer = module.make_optimizer(parameter_groups(module.model))

    def step(batch: Batch) -> Tensor:
        """Runs one training step; returns its loss."""
        with run.trainer.precision_plugin.train_step_context():
            loss = step_loss(batch)
        with stage("backward"):
            loss.backward()
        with stage("optimizer"):
            torch.nn.utils.clip_grad_norm_(module.model.trained_parameters(), 1.0)
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        return loss.detach()

    return step
