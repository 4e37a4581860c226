"""What a run keeps: the newest checkpoints, its curves, the state at SIGTERM."""

import csv
import multiprocessing
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning
import pytest
from lightning.pytorch.callbacks import LambdaCallback
from omegaconf import open_dict

from tests.reliability.crash_harness import RUN, STEPS
from tests.training_helpers import small_config
from vg2gt.runs.checkpoints import newest, read_checkpoint
from vg2gt.training.distributed import ending_together
from vg2gt.training.loop import build, train


class HappensAt(lightning.Callback):
    """Does something in a training step, and counts evaluations while training."""

    def __init__(self, step: int, action: Callable[[], object]) -> None:
        self.step = step
        self.action = action
        self.evaluations = 0

    def on_train_batch_start(self, trainer: lightning.Trainer, *args: Any) -> None:
        if trainer.global_step == self.step - 1:
            self.action()

    def on_validation_start(self, *args: Any) -> None:
        self.evaluations += 1


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in (folder / "checkpoints").iterdir())


def test_the_newest_are_kept(tmp_path: Path, cache: Path) -> None:
    """Across an interruption."""
    overrides = [*RUN, "callbacks.checkpoint.save_top_k=2", "callbacks.checkpoint.every_n_train_steps=1"]
    train(small_config(tmp_path, cache, *overrides, "trainer.max_steps=3"))
    assert names(tmp_path) == ["step-2.ckpt", "step-3.ckpt"]
    train(small_config(tmp_path, cache, *overrides, "trainer.max_steps=5", "ckpt=last"))
    assert names(tmp_path) == ["step-4.ckpt", "step-5.ckpt"]


def test_the_best_by_a_metric_is_kept(tmp_path: Path, cache: Path) -> None:
    """Item 32 of issue 47: as ``best.ckpt``, which no run resumes from by itself."""
    watch = ["callbacks=best", "trainer.val_check_interval=1", "optimizer.lr=0.05"]
    train(small_config(tmp_path, cache, *RUN, *watch, "trainer.max_steps=3"))
    curve = [(row["step"], float(row["eval/psnr"])) for row in rows(tmp_path) if row.get("eval/psnr")]
    during = dict(curve[1:4])  # the first is of the untrained head, the last one of the end
    assert len(during) == 3
    best = read_checkpoint(tmp_path / "checkpoints" / "best.ckpt")
    assert best["global_step"] == 1 + list(during.values()).index(max(during.values()))
    assert newest(tmp_path / "checkpoints").name == "step-3.ckpt"


def rows(folder: Path) -> list[dict[str, str]]:
    """The CSV logger's rows."""
    (path,) = (folder / "logs").glob("*/metrics.csv")
    with path.open() as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGUSR1])  # the last is SLURM's notice
def test_a_signal_saves_without_another_evaluation(tmp_path: Path, cache: Path, number: signal.Signals) -> None:
    stopped, before = HappensAt(3, lambda: signal.raise_signal(number)), signal.getsignal(number)
    run = build(small_config(tmp_path, cache, *RUN))
    run.trainer.callbacks.append(stopped)  # pyright: ignore[reportAttributeAccessIssue]
    run.trainer.fit(run.module, datamodule=run.datamodule)
    assert (newest(tmp_path / "checkpoints").name, stopped.evaluations) == ("step-3.ckpt", 0)
    assert signal.getsignal(number) == before


@pytest.mark.parametrize("moment", ["on_train_batch_start", "on_validation_start"])
def test_a_signal_in_the_last_step_or_after_it_leaves_the_evaluation_to_the_next_run(tmp_path, cache, moment) -> None:
    """``on_validation_start``: in the evaluation that belongs to the last step."""
    config = small_config(tmp_path, cache, *RUN, "trainer.max_steps=1", "trainer.val_check_interval=1", "ckpt=auto")
    with open_dict(config):
        config.callbacks.signal = {"_target_": f"{__name__}.signal_at", "moment": moment}
    assert train(config) == {}
    assert names(tmp_path) == ["step-1.ckpt"]
    assert not (tmp_path / "metrics.json").exists()
    del config.callbacks.signal
    assert train(config)["trained"]


def signal_at(moment: str) -> lightning.Callback:
    """SIGTERM at a moment of the training."""
    return LambdaCallback(
        **{moment: lambda trainer, *_: trainer.state.fn == "fit" and signal.raise_signal(signal.SIGTERM)}
    )


def test_a_signal_ends_an_evaluation_at_once(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lightning's own handler would only record it; the one that it records while it prepares is raised again."""
    run, handlers, raised = build(small_config(tmp_path, cache, *RUN)), [], []
    load = run.datamodule.val_dataloader
    monkeypatch.setattr(run.datamodule, "val_dataloader", lambda: os.kill(os.getpid(), signal.SIGTERM) or load())
    monkeypatch.setattr(signal, "raise_signal", raised.append)
    note = LambdaCallback(on_validation_batch_start=lambda *_: handlers.append(signal.getsignal(signal.SIGTERM)))
    run.trainer.callbacks.append(note)  # pyright: ignore[reportAttributeAccessIssue]
    before = signal.getsignal(signal.SIGTERM)
    run.trainer.validate(run.module, datamodule=run.datamodule, verbose=False)
    signal.signal(signal.SIGTERM, before)
    assert handlers == [signal.SIG_DFL]
    assert raised == [signal.SIGTERM]


def test_slurms_notice_during_an_evaluation_leaves_the_requeueing_to_the_job(tmp_path, cache, monkeypatch) -> None:
    """In the environment of a SLURM job, with a stand-in for the command with which Lightning would requeue it."""
    asked = tmp_path / "requeued"
    stand_in = tmp_path / "bin" / "scontrol"
    stand_in.parent.mkdir()
    stand_in.write_text(f"#!/bin/sh\necho $* >> {asked}\n")
    stand_in.chmod(0o755)
    monkeypatch.setenv("PATH", str(stand_in.parent), prepend=os.pathsep)
    for name, value in {"JOB_ID": "4242", "JOB_NAME": "train", "NTASKS": "1", "PROCID": "0", "NODEID": "0"}.items():
        monkeypatch.setenv(f"SLURM_{name}", value)
    config = small_config(tmp_path / "run", cache, *RUN, "ckpt=auto")
    with open_dict(config):
        config.callbacks.notice = {"_target_": f"{__name__}.NoticeOnce", "given": str(tmp_path / "given")}
    with pytest.raises(SystemExit) as left:
        train(config)
    assert left.value.code == 0
    assert not asked.exists()
    assert not list((tmp_path / "run").rglob("*.ckpt"))
    assert train(config)["steps"] == STEPS


class NoticeOnce(lightning.Callback):
    """SLURM's notice in the first evaluation; ``given`` is the file that says so."""

    def __init__(self, given: str) -> None:
        self.given = Path(given)

    def on_validation_batch_start(self, *args: Any) -> None:
        if not self.given.exists():
            self.given.touch()
            signal.raise_signal(signal.SIGUSR1)


def test_a_killed_process_that_loads_data_is_one_error(tmp_path: Path, cache: Path) -> None:
    def kill() -> None:
        for process in multiprocessing.active_children():
            process.kill()

    overrides = ["data.workers=1", "callbacks.checkpoint=null", "logger.csv=null", "trainer.max_steps=50"]
    run = build(small_config(tmp_path, cache, *RUN, *overrides))
    run.trainer.callbacks.append(HappensAt(2, kill))  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(ChildProcessError, match="data loading process was killed"), ending_together(run.trainer):
        run.trainer.fit(run.module, datamodule=run.datamodule)
