"""Kernels are compiled before a training, in processes of their own, once."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SMALL = ["data.image_size=[28,56]", "data.train_scenes=1", "data.eval_scenes=1", "trainer.max_steps=1"]
# Every compilation that numba makes is one line; in another process it cannot be seen, its printing being turned off.
WATCH = """
import sys
from numba.core import event
class Say(event.Listener):
    def on_start(self, event):
        print("COMPILES", event.data["dispatcher"].py_func.__name__, flush=True)
    def on_end(self, event):
        pass
event.register("numba:compile", Say())
from vg2gt.cli.train import main
main()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux only")
def test_a_training_compiles_nothing_itself_and_once(tmp_path: Path) -> None:
    def said(name: str) -> str:
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
        command = [sys.executable, "-c", WATCH, f"name={name}", f"data.cache_dir={tmp_path / 'rooms'}", *SMALL]
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=500, check=False
        )
        assert done.returncode == 0, done.stderr[-3000:]
        return done.stdout + done.stderr

    first, second = said("first"), said("second")
    compiled = {line.split()[1] for line in first.splitlines() if line.startswith("COMPILES")}
    assert "compiling kernels, once" in first
    assert not compiled
    assert "compiling kernels" not in second
    assert "COMPILES" not in second
