"""Kernels are compiled before a training, in processes of their own, once."""

import multiprocessing
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch

from tests.training_helpers import small_config
from vg2gt.data.datamodule import SceneDataModule
from vg2gt.io.compiled import cache_folder
from vg2gt.rendering import Renderer
from vg2gt.studies.study import compose_run
from vg2gt.training import loop
from vg2gt.training.loop import build

ROOT = Path(__file__).resolve().parents[2]
SMALL = ["data.image_size=[28,56]", "data.train_scenes=1", "data.eval_scenes=1", "trainer.max_steps=1"]
# Every compilation that numba makes is one line; in another process it cannot be seen, its printing being turned off.
WATCH = """
import sys
from numba.core import event
class Say(event.Listener):
    def on_start(self, event):
        name = event.data["dispatcher"].py_func.__name__
        if name != "_nothing":  # which loads the compiler before it is needed
            print("COMPILES", name, flush=True)
    def on_end(self, event):
        pass
event.register("numba:compile", Say())
"""
# What other processes would compile they find among the kernels that other tests have compiled, where it is there.
FOUND = """
import os, shutil
from pathlib import Path
from vg2gt.io import compiled_files

load, parent = compiled_files._Files.load, os.getpid()
def load_or_find(self, key):
    path = self._path(key)
    found = Path(os.environ["KERNELS"], path.relative_to(os.environ["NUMBA_CACHE_DIR"] + "/vg2gt"))
    if os.getpid() != parent and found.is_file() and not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(found, path)
    return load(self, key)
compiled_files._Files.load = load_or_find
"""
TRAIN = "from vg2gt.cli.train import main; main()"


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux only")
@pytest.mark.parametrize("found", [FOUND, pytest.param("", marks=pytest.mark.slow)], ids=["found", "compiled"])
def test_the_first_training_of_a_machine_compiles_nothing_itself(found: str, tmp_path: Path) -> None:
    kernels = tmp_path / "kernels"
    folders = {"NUMBA_CACHE_DIR": str(kernels), "KERNELS": str(cache_folder() or tmp_path)}
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **folders}
    command = [sys.executable, "-c", WATCH + found + TRAIN, f"data.cache_dir={tmp_path / 'rooms'}", *SMALL]
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=500, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "compiling kernels, once" in done.stdout + done.stderr
    assert [line for line in done.stdout.splitlines() if line.startswith("COMPILES")] == []
    assert len(list(kernels.rglob("*.nbc"))) > 12
    assert len(list(kernels.glob("vg2gt/compiled-*"))) == 1


@pytest.mark.parametrize(("marked", "threads"), [(True, 1), (False, 2)])
def test_where_it_was_done_or_no_process_can_be_forked_nothing_is(
    marked: bool, threads: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from vg2gt.training import compilation

    mark = tmp_path / "compiled"
    if marked:
        mark.mkdir()
    monkeypatch.setattr(compilation, "compiled_mark", lambda: mark)
    monkeypatch.setattr(compilation.threading, "active_count", lambda: threads)
    monkeypatch.setattr(compilation.multiprocessing, "get_context", lambda kind: pytest.fail("a process is forked"))
    compilation.compile_kernels(Renderer(), lambda: pytest.fail("a step is prepared"))
    assert mark.is_dir() == marked


@pytest.mark.parametrize(
    "overrides",
    [["debug=fast_dev_run"], ["trainer=gpu"], ["trainer=ddp"]],
    ids=["a trial", "on a GPU", "on several devices"],
)
def test_nothing_is_begun_for_a_run_that_would_not_wait_for_it(
    overrides: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from vg2gt.training import compilation

    monkeypatch.setattr(compilation, "_to_compile", lambda: True)
    monkeypatch.setattr(compilation, "_forked", lambda *work: pytest.fail("a process is forked"))
    assert compilation.begin_compiling(compose_run(overrides, tmp_path)) is None


def test_the_parent_works_on_one_thread_until_the_other_process_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    from vg2gt.training import compilation

    alive = iter([True, True, True, False])
    monkeypatch.setattr(compilation, "_to_compile", lambda: True)
    monkeypatch.setattr(compilation, "compiled_mark", lambda: None)
    forked = [Mock(name="rendering", **{"is_alive.return_value": False}), Mock(name="rest")]
    forked[1].is_alive = lambda: next(alive, False)
    monkeypatch.setattr(compilation, "_forked", lambda *work: forked.pop(0))
    before, threads = torch.get_num_threads(), []

    def pieces() -> Iterator[int]:
        while True:
            threads.append(torch.get_num_threads())
            yield 0

    compilation.compile_kernels(Renderer(), lambda: lambda: torch.zeros(()), meanwhile=pieces())
    assert threads == [1, 1, 1]
    assert torch.get_num_threads() == before


def test_a_process_that_does_not_end_is_not_waited_for_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    from vg2gt.training import compilation

    monkeypatch.setattr(compilation, "_to_compile", lambda: True)
    monkeypatch.setattr(compilation, "compiled_mark", lambda: None)
    monkeypatch.setattr(compilation, "PATIENCE", 0.1)
    rest = Mock(**{"is_alive.return_value": True})
    forked = [Mock(**{"is_alive.return_value": False}), rest]
    monkeypatch.setattr(compilation, "_forked", lambda *work: forked.pop(0))
    compilation.compile_kernels(Renderer(), lambda: lambda: torch.zeros(()), meanwhile=count())
    rest.kill.assert_called_once_with()


def test_the_loaders_processes_are_not_started_to_compile(tmp_path: Path) -> None:
    """They would hold a second copy of the frames for as long as the run lasts."""
    run = build(small_config(tmp_path, tmp_path / "rooms", "data.workers=1"))
    data = run.datamodule
    assert isinstance(data, SceneDataModule)
    before = set(multiprocessing.active_children())
    step = loop._first_step(run.module, data)
    assert not list(loop._first_batches(data))
    assert set(multiprocessing.active_children()) <= before
    assert step().isfinite()
    data.workers = 0
    batches = loop._first_batches(data)
    assert next(batches).num_context == next(iter(data.val_dataloader())).num_context


def most_page_faults() -> int:
    """The largest number of page faults of a hundred calls, from anywhere on the stack."""

    def leaf() -> None:
        pass

    leaf.__code__ = leaf.__code__.replace(co_stacksize=100)  # so that it does not fit where little is left

    def down(levels: int) -> int:
        if levels:
            return down(levels - 1)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        for _ in range(100):
            leaf()
        return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

    return max(down(levels) for levels in range(300))


@pytest.mark.skipif(sys.platform != "linux", reason="page faults are counted as on Linux")
def test_calls_of_what_compiles_take_no_memory_from_the_system() -> None:
    from vg2gt.training import compilation

    found: list[int] = []
    compilation._in_one_chunk(lambda *given: found.extend((*given, most_page_faults())), (1, 2))
    assert found[:2] == [1, 2]
    if most_page_faults() < 90:
        pytest.skip("this Python keeps the memory of frames")
    assert found[2] < 20
