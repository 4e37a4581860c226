"""What the benchmarks share: options, the machine, clocks and peak memory, a training step, result files."""

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

# Real scenes that nothing here was trained on, as trainings evaluate theirs: 8 input views at the given poses.
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
    """A parser of the options that the benchmarks have in common.

    Args:
        doc: the script's docstring.
        out: default of ``--out``, where results are written.
        device: whether there is ``--device``; its default is a GPU if there is one.
        threads: default of ``--threads``; None: no such option.
        passes: default of ``--passes``; None: no such option.
        overrides: help of the Hydra overrides after all options; None: there are none.
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
    """The command line of a study: its own ``key=value`` pairs over their defaults, and all else, which is Hydra's.

    Raises:
        SystemExit: after printing ``doc`` where help is asked for.
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
    """Where today's results of a name go."""
    return folder / f"{date.today().isoformat()}-{name}.json"


def evaluation_scenes(overrides: str) -> Iterator[Batch]:
    """The scenes, or windows of a recording, on which a data configuration is evaluated."""
    data = instantiate(compose("train", *overrides.split()).data)
    data.setup("validate")
    yield from data.val_dataloader()


def write_results(folder: Path, name: str, content: Mapping[str, Any]) -> Path:
    """Writes ``<date>-<name>.json`` and prints where; returns the path."""
    path = write_json(dated(folder, name), dict(content))
    print(path)
    return path


def machine(device: torch.device | str = "cpu") -> dict[str, Any]:
    """Processor, cores and versions, and the GPU's name if ``device`` is one."""
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
    """Seconds of all cores on a CPU, which other processes hardly change; by the clock on a GPU that is done."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
        return time.perf_counter()
    return time.process_time()


class PeakMemory:
    """The most memory in use since ``restart``: allocated on a GPU, resident (VmHWM) in the process on a CPU.

    Attributes:
        start: bytes in use when this was made.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        if device.type == "cuda":
            torch.cuda.empty_cache()
            self.start = torch.cuda.memory_allocated(device)
        else:
            # What was freed goes back to the system, or what follows would be served from it unseen.
            ctypes.CDLL(None).malloc_trim(0)
            self.start = status("VmRSS")
        self.restart()

    def restart(self) -> None:
        """Forgets the peak so far."""
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)
        else:
            Path("/proc/self/clear_refs").write_text("5")  # sets the high-water mark to what is resident now

    @property
    def peak(self) -> int:
        """Bytes in use at the peak."""
        return torch.cuda.max_memory_allocated(self.device) if self.device.type == "cuda" else status("VmHWM")

    @property
    def megabytes(self) -> float:
        """The peak above the start."""
        return (self.peak - self.start) / MEGABYTE


def status(name: str) -> int:
    """A figure of this process in bytes, by its name in ``/proc/self/status``."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{name}:"))


def training_step(run: Run) -> Callable[[Batch], Tensor]:
    """The run's training step without its loop: a function from a batch to the loss; nothing is logged."""
    module = run.module.train()
    run.trainer.strategy.connect(module)
    module.trainer = run.trainer
    module.log = lambda *args, **kwargs: None  # type: ignore[method-assign]
    return lambda batch: module.training_step(batch, 0)


def whole_step(
    run: Run, stage: Callable[[str], AbstractContextManager[Any]] = nullcontext
) -> Callable[[Batch], Tensor]:
    """:func:`training_step` with backward pass, clipping and optimiser, the latter two in stages of their own."""
    step_loss, module = training_step(run), run.module
    optimizer = module.make_optimizer(parameter_groups(module.model))

    def step(batch: Batch) -> Tensor:
        """The loss of one training step."""
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
