"""The callback that returns freed memory to the system."""

import os
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch
from hydra.errors import InstantiationException

from tests.training_helpers import small_config
from vg2gt.training.loop import build, train
from vg2gt.training.memory import ReturnFreeMemory

MIB = 2**20


def resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def trainer(step: int, device: str = "cpu") -> Any:
    return SimpleNamespace(global_step=step, strategy=SimpleNamespace(root_device=torch.device(device)))


@pytest.mark.skipif(sys.platform != "linux", reason="malloc_trim is a function of glibc, on Linux")
def test_free_memory_between_blocks_in_use_is_returned() -> None:
    callback = ReturnFreeMemory(2)
    callback.setup(trainer(0), cast(Any, None), "fit")
    if callback._trim is None:
        pytest.skip("this C library has no malloc_trim")
    blocks = [bytearray(100_000) for _ in range(2000)]  # below the size from which malloc uses mmap
    full = resident()
    kept = blocks[::10]
    del blocks  # free memory between blocks in use, which malloc keeps
    callback.on_train_batch_start(trainer(1))  # not due
    assert full - resident() < 50 * MIB
    callback.on_train_batch_start(trainer(2))
    assert full - resident() > 120 * MIB
    assert len(kept) == 200


def test_a_gpu_run_is_left_alone() -> None:
    callback = ReturnFreeMemory()
    callback.setup(trainer(0, "cuda"), cast(Any, None), "fit")
    callback.on_validation_batch_start()
    assert callback._trim is None


def test_every_run_on_a_cpu_has_it(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before the scenes of both evaluations, and before steps 0 and 2 of three."""
    calls: list[int] = []
    monkeypatch.setattr(ReturnFreeMemory, "_return", lambda self: calls.append(1))
    train(small_config(tmp_path, cache, "trainer.max_steps=3", "data.eval_scenes=1"))
    assert len(calls) == 4


def test_zero_steps_are_refused(tmp_path: Path, cache: Path) -> None:
    with pytest.raises(InstantiationException, match="every_n_steps must be at least 1"):
        build(small_config(tmp_path, cache, "callbacks.memory.every_n_steps=0"))
