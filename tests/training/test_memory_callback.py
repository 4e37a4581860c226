"""The callback that returns freed memory to the system."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch
from hydra.errors import InstantiationException

from tests.training_helpers import small_config
from vg2gt.training.loop import build, train
from vg2gt.training.memory import ReturnFreeMemory, _resident_mb


def trainer(device: str = "cpu") -> Any:
    return SimpleNamespace(strategy=SimpleNamespace(root_device=torch.device(device)))


@pytest.mark.skipif(sys.platform != "linux", reason="malloc_trim is a function of glibc, on Linux")
def test_free_memory_between_blocks_in_use_is_returned() -> None:
    callback = ReturnFreeMemory(100)
    callback.setup(trainer(), cast(Any, None), "fit")
    if callback._trim is None:
        pytest.skip("this C library has no malloc_trim")
    callback.on_train_batch_start()
    few = [bytearray(100_000) for _ in range(500)]  # below the size from which malloc uses mmap
    trim, callback._trim = callback._trim, lambda pad: pytest.fail("grown by less than 100 MB")
    callback.on_train_batch_start()
    callback._trim = trim
    blocks = [bytearray(100_000) for _ in range(2000)]
    full = _resident_mb()
    kept = blocks[::10]
    del blocks  # free memory between blocks in use, which malloc keeps
    assert full - _resident_mb() < 50
    callback.on_train_batch_start()
    assert full - _resident_mb() > 120
    assert len(kept) + len(few) == 700


def test_a_gpu_run_is_left_alone() -> None:
    callback = ReturnFreeMemory()
    callback.setup(trainer("cuda"), cast(Any, None), "fit")
    callback.on_validation_batch_start()
    assert callback._trim is None


def test_every_run_on_a_cpu_has_it(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before the scenes of both evaluations and before both steps."""
    calls: list[int] = []
    monkeypatch.setattr(ReturnFreeMemory, "_return", lambda self: calls.append(1))
    train(small_config(tmp_path, cache, "trainer.max_steps=2", "data.eval_scenes=1"))
    assert len(calls) == 4


def test_negative_growth_is_refused(tmp_path: Path, cache: Path) -> None:
    with pytest.raises(InstantiationException, match="growth_mb must not be negative"):
        build(small_config(tmp_path, cache, "+callbacks.memory.growth_mb=-1"))


@pytest.mark.skipif(sys.platform != "linux", reason="torch asks for large pages on Linux only")
@pytest.mark.parametrize("chosen", [None, "0"])
def test_tensors_of_a_training_lie_on_large_pages(chosen: str | None, tmp_path: Path) -> None:
    """torch aligns their memory to pages (4096 bytes), and to 64 bytes otherwise."""
    code = f"""
import sys, types
sys.modules["vg2gt.training.loop"] = types.SimpleNamespace(train=lambda config: None)
from vg2gt.cli.train import main
sys.argv = ["train.py"]
main()
assert "torch" not in sys.modules
import torch
tensors = [torch.empty(2**22 + size) for size in range(4)]
assert all(tensor.data_ptr() % 4096 == 0 for tensor in tensors) is {chosen is None}
"""
    others = {name: value for name, value in os.environ.items() if name != "THP_MEM_ALLOC_ENABLE"}
    environment = others | ({} if chosen is None else {"THP_MEM_ALLOC_ENABLE": chosen})
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
