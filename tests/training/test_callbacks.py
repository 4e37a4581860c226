"""What a run keeps: the newest checkpoints, the row of a checkpoint's step, the state at SIGTERM."""

import shutil
import signal
from pathlib import Path
from typing import Any

import lightning
import pytest

from tests.reliability.crash_harness import RUN
from tests.training_helpers import small_config
from vg2gt.runs.checkpoints import newest_valid, read_checkpoint
from vg2gt.studies.curves import read_curves
from vg2gt.training.callbacks import NewestCheckpoints
from vg2gt.training.loop import build, train


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("rooms")


class TerminatedAt(lightning.Callback):
    """Sends SIGTERM to the own process in a training step, and counts evaluations while training."""

    def __init__(self, step: int) -> None:
        self.step = step
        self.evaluations = 0

    def on_train_batch_start(self, trainer: lightning.Trainer, *args: Any) -> None:
        if trainer.global_step == self.step - 1:
            signal.raise_signal(signal.SIGTERM)

    def on_validation_start(self, *args: Any) -> None:
        self.evaluations += 1


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in (folder / "checkpoints").iterdir())


def test_the_newest_are_kept_whoever_saved_them(tmp_path: Path, cache: Path) -> None:
    """As after a kill between a rename and a deletion, and a stop by SIGTERM: nothing stays for good."""
    folder = tmp_path / "checkpoints"
    folder.mkdir()
    for name in ("step-0.ckpt", "step-0-old.ckpt"):
        (folder / name).write_bytes(b"an older one")
    (folder / "of the user.ckpt").write_bytes(b"something else")
    run = build(small_config(tmp_path, cache, *RUN, "callbacks.checkpoint.save_top_k=2", "logger.csv=null"))
    run.trainer.fit(run.module, datamodule=run.datamodule)
    assert names(tmp_path) == ["of the user.ckpt", "step-4.ckpt", "step-6.ckpt"]


def test_all_can_be_kept(tmp_path: Path, cache: Path) -> None:
    overrides = ["callbacks.checkpoint.save_top_k=-1", "callbacks.checkpoint.every_n_train_steps=1", "logger.csv=null"]
    run = build(small_config(tmp_path, cache, *RUN, *overrides))
    run.trainer.fit(run.module, datamodule=run.datamodule)
    assert len(names(tmp_path)) == 6


@pytest.mark.parametrize(("every", "kept"), [(0, 3), (10, 0), (10, -2)])
def test_senseless_numbers_are_refused(every: int, kept: int) -> None:
    with pytest.raises(ValueError, match=f"every_n_train_steps={every} .* save_top_k={kept}"):
        NewestCheckpoints("checkpoints", every, kept)


def test_a_checkpoint_carries_the_row_of_its_step(tmp_path: Path, cache: Path) -> None:
    """A process that goes on from it, without the log of the one before, writes it."""
    overrides = ["callbacks.checkpoint.every_n_train_steps=4", "trainer.val_check_interval=1000"]
    run = build(small_config(tmp_path, cache, *RUN, *overrides))
    run.trainer.fit(run.module, datamodule=run.datamodule)
    logged = {name: curve[3] for name, curve in read_curves(tmp_path).items() if 3 in curve}
    saved = read_checkpoint(tmp_path / "checkpoints" / "step-4.ckpt")["last_row"]
    assert saved == {"step": 3, "epoch": 0, "values": logged}
    assert len(logged) > 5
    shutil.rmtree(tmp_path / "logs")
    train(small_config(tmp_path, cache, *RUN, "ckpt=last"))
    curves = read_curves(tmp_path)
    assert {name: curve[3] for name, curve in curves.items() if 3 in curve} == logged
    assert list(curves["loss"]) == [3, 4, 5]


def test_sigterm_saves_without_another_evaluation(tmp_path: Path, cache: Path) -> None:
    stopped = TerminatedAt(3)
    run = build(small_config(tmp_path, cache, *RUN))
    run.trainer.callbacks.append(stopped)  # pyright: ignore[reportAttributeAccessIssue]
    run.trainer.fit(run.module, datamodule=run.datamodule)
    assert newest_valid(tmp_path / "checkpoints").name == "step-3.ckpt"
    assert stopped.evaluations == 0


def test_signals_are_as_before_the_run(tmp_path: Path, cache: Path) -> None:
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGUSR1)}
    train(small_config(tmp_path, cache, *RUN, "trainer.max_steps=1"))
    assert {number: signal.getsignal(number) for number in before} == before
