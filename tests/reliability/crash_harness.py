"""Starts trainings in their own process groups, kills them at chosen moments and resumes them until they finish."""

from __future__ import annotations

import csv
import importlib
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from tests.commands import become, warm_process
from tests.training_helpers import SMALL
from vg2gt.io.files import read_json
from vg2gt.runs.checkpoints import read_checkpoint

PATIENCE = 600.0  # seconds until a process that does not end is taken to hang
STEPS = 6
# Evaluations inside the training, checkpoints at every second step, a log row a step.
RUN = [
    *SMALL,
    "data.image_size=[28,56]",
    "data.eval_context=2",
    "data.eval_target=1",
    f"trainer.max_steps={STEPS}",
    "trainer.val_check_interval=4",
]

TRAIN = "vg2gt.cli.train"

Moment = Callable[["Attempt"], bool]


def _run_main(module: str, arguments: list[str], output: str, folder: str) -> None:
    os.setsid()
    become(folder, [output])
    command = importlib.import_module(module)
    sys.argv = [str(command.__file__), *arguments]
    command.main()


@dataclass
class Attempt:
    """One process of a run."""

    folder: Path
    output: Path
    process: Any
    before: set[tuple[str, int]]
    started: float = field(default_factory=time.monotonic)

    def status(self) -> int | None:
        """Its exit status, None while it runs."""
        return self.process.exitcode

    def new(self) -> set[str]:
        """Names, relative to the folder, of all that this process has written."""
        return {name for name, _ in _contents(self.folder) - self.before}

    def log(self) -> str:
        """The log that this process writes; empty until it does."""
        files = [name for name in self.new() if name.endswith("metrics.csv")]
        return (self.folder / files[0]).read_text() if files else ""

    def said(self) -> str:
        """What it has written to the terminal so far."""
        return self.output.read_text(errors="replace") if self.output.is_file() else ""

    def kill(self) -> None:
        """SIGKILL to the whole process group, or to a process that has not founded it yet."""
        for send in (os.killpg, os.kill):
            with suppress(ProcessLookupError):
                send(self.process.pid, signal.SIGKILL)
        self.wait()

    def wait(self) -> int:
        """Waits for the end; returns the exit status."""
        self.process.join(PATIENCE)
        return self.process.exitcode

    def wait_for(self, moment: Moment) -> bool:
        """Whether the moment came before the process ended."""
        while time.monotonic() - self.started < PATIENCE:
            if moment(self):
                return True
            if self.status() is not None:
                return False
            time.sleep(0.0002)
        self.kill()
        raise TimeoutError(f"{self.folder} waited {PATIENCE:g} s:\n{self.said()[-3000:]}")


def start(module: str, arguments: Sequence[str], folder: Path) -> Attempt:
    """Starts a command in a new process group."""
    output, before = folder.with_name(f"{folder.name}.out"), _contents(folder)
    process = warm_process(_run_main, module, list(arguments), str(output), str(folder.parent))
    return Attempt(folder, output, process, before)


def training(folder: Path, cache: Path, *overrides: str) -> list[str]:
    """The command line that starts and resumes a run."""
    fixed = [f"output_dir={folder}", f"hydra.run.dir={folder}", f"data.cache_dir={cache}", "ckpt=auto"]
    return [*fixed, *RUN, *overrides]


def finish(module: str, arguments: Sequence[str], folder: Path) -> None:
    """Lets a command run to its end."""
    attempt = start(module, arguments, folder)
    status = attempt.wait()
    assert status == 0, f"status {status}:\n{attempt.said()[-4000:]}"


# ------------------------------------------------------------------------------------------------------- moments


def while_a_checkpoint_is_written(attempt: Attempt) -> bool:
    """A checkpoint has only its temporary name."""
    return any(name.startswith("checkpoints/") and name.endswith(".tmp") for name in attempt.new())


def after_a_checkpoint(attempt: Attempt) -> bool:
    """A checkpoint has its name, the oldest is not yet deleted; the step's row is not yet in the log."""
    return any(name.endswith(".ckpt") for name in attempt.new())


def in_validation(attempt: Attempt) -> bool:
    """The row of the step before the evaluation is logged; that of the evaluation, and the checkpoint, come later."""
    log = attempt.log()
    if "train/" not in log:
        return False
    column = log.split("\n", 1)[0].split(",").index("step")
    return any(line.split(",")[column] == "3" for line in log.splitlines()[1:])


def in_first_evaluation(attempt: Attempt) -> bool:
    """The run's configuration is written, the metrics of the untrained head are not."""
    return "config.yaml" in attempt.new()


def in_last_evaluation(attempt: Attempt) -> bool:
    """The last checkpoint is there, what trains and evaluates has begun, the report is not there."""
    last = attempt.folder / "checkpoints" / f"step-{STEPS}.ckpt"
    return last.is_file() and any(name.startswith("logs/version_") for name in attempt.new())


def while_the_report_is_written(attempt: Attempt) -> bool:
    """The metrics are there, what is written after them may be missing."""
    return "metrics.json" in attempt.new()


def _contents(folder: Path) -> set[tuple[str, int]]:
    """Relative names and times of all in a folder."""
    found = set()
    for path in folder.rglob("*"):
        with suppress(FileNotFoundError):  # renamed meanwhile
            found.add((str(path.relative_to(folder)), path.stat().st_mtime_ns))
    return found


# ------------------------------------------------------------------------------------------------------- results


def check_files(folder: Path) -> None:
    """Reads every file that a killed run left under a final name."""
    for path in folder.glob("checkpoints/*.ckpt"):
        read_checkpoint(path)
    for path in folder.glob("*.json"):
        read_json(path)


def assert_same(whole: Path, resumed: Path) -> None:
    """Weights, optimiser state, schedule, metrics and curves are equal bit for bit, and nothing is left over."""
    names = sorted(path.name for path in (whole / "checkpoints").iterdir())
    assert sorted(path.name for path in (resumed / "checkpoints").iterdir()) == names
    for name in names:
        expected, found = (read_checkpoint(folder / "checkpoints" / name) for folder in (whole, resumed))
        for key in ("state_dict", "optimizer_states", "lr_schedulers", "global_step", "skipped_steps"):
            assert_equal(expected[key], found[key], f"{name}:{key}")
    for name in ("untrained.json", "metrics.json"):
        assert read_json(whole / name) == read_json(resumed / name), name
    for name in ("metrics.md", "preview.png"):
        assert (whole / name).read_bytes() == (resumed / name).read_bytes(), name
    # a process killed between a checkpoint and its row loses that row
    expected, found = read_curves(whole), read_curves(resumed)
    for name, curve in found.items():
        if name.startswith("train/"):
            assert curve.items() <= expected[name].items(), name
    assert not list(resumed.rglob("*.tmp"))


def read_curves(run: Path) -> dict[str, dict[int, str]]:
    """What a run logged by metric and step; rows that a killed process did not finish have no line break."""
    curves: dict[str, dict[int, str]] = {}
    for path in sorted(run.glob("logs/version_*/metrics.csv"), key=lambda path: int(path.parent.name.split("_")[1])):
        for row in csv.DictReader(path.read_text().rpartition("\n")[0].splitlines()):
            for name, value in row.items():
                if value:
                    curves.setdefault(name, {})[int(row["step"])] = value
    return curves


def assert_equal(expected: Any, found: Any, name: str) -> None:
    """Equality of nested containers with tensors in them."""
    assert type(expected) is type(found), name
    if isinstance(expected, torch.Tensor):
        assert torch.equal(expected, found), name
    elif isinstance(expected, dict):
        assert expected.keys() == found.keys(), name
        for key in expected:
            assert_equal(expected[key], found[key], f"{name}.{key}")
    elif isinstance(expected, list | tuple):
        assert len(expected) == len(found), name
        for index, pair in enumerate(zip(expected, found, strict=True)):
            assert_equal(*pair, f"{name}[{index}]")
    else:
        assert expected == found, name
