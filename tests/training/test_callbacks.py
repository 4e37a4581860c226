"""What a run keeps: the newest checkpoints, the row of a checkpoint's step, the state at SIGTERM."""

import multiprocessing
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lightning
import pytest

from tests.reliability.crash_harness import RUN
from tests.training_helpers import small_config
from vg2gt.runs.checkpoints import newest_valid, read_checkpoint
from vg2gt.studies.curves import read_curves
from vg2gt.training.callbacks import NewestCheckpoints
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


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_saves_without_another_evaluation(tmp_path: Path, cache: Path, number: signal.Signals) -> None:
    stopped = HappensAt(3, lambda: signal.raise_signal(number))
    run = build(small_config(tmp_path, cache, *RUN))
    run.trainer.callbacks.append(stopped)  # pyright: ignore[reportAttributeAccessIssue]
    run.trainer.fit(run.module, datamodule=run.datamodule)
    assert newest_valid(tmp_path / "checkpoints").name == "step-3.ckpt"
    assert stopped.evaluations == 0


def test_a_run_whose_folder_vanishes_is_kept_beside_it(tmp_path: Path, cache: Path) -> None:
    folder, renamed = tmp_path / "run", tmp_path / "renamed"
    run = build(small_config(folder, cache, *RUN))
    run.trainer.callbacks.append(HappensAt(3, lambda: folder.rename(renamed)))  # pyright: ignore
    with pytest.raises(FileNotFoundError, match=r"run was deleted or renamed .* saved .*run-kept.*step-3\.ckpt; go on"):
        run.trainer.fit(run.module, datamodule=run.datamodule)
    assert read_checkpoint(tmp_path / "run-kept" / "checkpoints" / "step-3.ckpt")["global_step"] == 3
    assert "step-2.ckpt" in [path.name for path in (renamed / "checkpoints").iterdir()]


def test_a_killed_process_that_loads_data_is_one_error(tmp_path: Path, cache: Path) -> None:
    def kill() -> None:
        for process in multiprocessing.active_children():
            process.kill()

    overrides = ["data.workers=1", "callbacks.checkpoint=null", "logger.csv=null", "trainer.max_steps=50"]
    run = build(small_config(tmp_path, cache, *RUN, *overrides))
    run.trainer.callbacks.append(HappensAt(2, kill))  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(ChildProcessError, match="loads data was killed"), ending_together(run.trainer):
        run.trainer.fit(run.module, datamodule=run.datamodule)


@pytest.mark.parametrize("said", ["[..] Connection closed by peer [127.0.0.1]:9", "Gloo connectFullMesh failed"])
def test_a_rank_that_has_ended_is_named(said: str) -> None:
    started = SimpleNamespace(procs=[SimpleNamespace(poll=lambda: None), SimpleNamespace(poll=lambda: -9)])
    started.kill = lambda number: None
    trainer: Any = SimpleNamespace(strategy=SimpleNamespace(launcher=started), world_size=3)
    with (
        pytest.raises(ChildProcessError, match=r"^rank 2 has ended with status -9; .* ckpt=last"),
        ending_together(trainer),
    ):
        raise RuntimeError(said)
    with pytest.raises(RuntimeError, match="shapes"), ending_together(trainer):
        raise RuntimeError("shapes differ")


def test_signals_are_as_before_the_run(tmp_path: Path, cache: Path) -> None:
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1)}
    train(small_config(tmp_path, cache, *RUN, "trainer.max_steps=1"))
    assert {number: signal.getsignal(number) for number in before} == before
