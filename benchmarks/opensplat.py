"""Trains scenes with OpenSplat on a CPU, for comparison (``photos.py --opensplat BINARY``).

The published CPU code blends Gaussians in the wrong order (it reads their depths through a strided view) and ignores
the principal point. Fix both in ``project_gaussians_forward_tensor_cpu`` before a comparison.
"""

from __future__ import annotations

import os
import subprocess
from collections import deque
from dataclasses import dataclass
from pathlib import Path

STEPS = 100  # of the first run, which measures the time per step
NEAR_ENOUGH = 0.1  # relative tolerance of the budget
TRIES = 3
BACKGROUND = (0.6130, 0.0101, 0.3984)  # OpenSplat's background colour


@dataclass(frozen=True)
class Training:
    """A scene trained by OpenSplat.

    Attributes:
        steps: number of training steps.
        core_seconds: CPU time from the first step on, without loading libraries and images.
        peak_memory: maximum resident memory in bytes.
    """

    steps: int
    core_seconds: float
    peak_memory: int


def train(binary: Path, photos: Path, scene: Path, budget: float, pace: float | None = None) -> Training:
    """Trains on one thread for about ``budget`` core-seconds.

    OpenSplat only accepts a number of steps. A training that misses its budget by 10 % or more is repeated with a
    corrected number of steps, in at most 3 runs.

    Args:
        binary: OpenSplat's program.
        photos: COLMAP scene.
        scene: PLY file to write, in the frame of the given cameras; cameras are written to the same folder.
        budget: budget in core-seconds.
        pace: expected core-seconds per step; None measures it first.

    Raises:
        RuntimeError: if the program fails; includes the end of its output.
    """
    if pace is None:
        tried = _train(binary, photos, scene, STEPS)
        pace = tried.core_seconds / tried.steps
    steps = max(1, round(budget / pace))
    for _ in range(TRIES):
        run = _train(binary, photos, scene, steps)
        if abs(1 - run.core_seconds / budget) < NEAR_ENOUGH:
            break
        steps = max(1, round(steps * budget / run.core_seconds))
    return run


def _train(binary: Path, photos: Path, scene: Path, steps: int) -> Training:
    scene.unlink(missing_ok=True)
    scene.parent.mkdir(parents=True, exist_ok=True)
    command = [str(binary), str(photos), "--cpu", "--keep-crs", f"--output={scene}"]
    # a short training; the defaults are for 30,000 steps
    command += [f"--num-iters={steps}", "--num-downscales=0", f"--warmup-length={min(500, steps // 5)}"]
    command.append(f"--sh-degree-interval={min(1000, max(1, steps // 4))}")
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)
    assert process.stdout is not None
    loaded, said = None, deque(maxlen=11)
    for line in process.stdout:
        if loaded is None and line.startswith("Step "):
            fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
            loaded = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")  # CPU time so far
        said.append(line)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode or loaded is None or not scene.is_file():
        raise RuntimeError(f"{' '.join(command)} failed: {''.join(said)}")
    return Training(steps, usage.ru_utime + usage.ru_stime - loaded, usage.ru_maxrss * 1024)
