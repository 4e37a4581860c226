"""Long trainings on small images: ``python benchmarks/small_images.py --size 28 56 --views 3 [--steps N] [overrides]``.

Trains the default configuration (or any other, by overrides) on procedural rooms, and looks at every step's loss, norm
of the gradient before clipping, hinge on enhanced points (``enhance_point``) and resident memory. Least, median and
largest over windows of steps go to a dated JSON file in ``benchmarks/results``, under the size and the number of views,
beside what other calls have written there; after each window, so that a run which is stopped has its beginning there.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning
import torch
from common import dated, machine, parser, status

from vg2gt.io.files import read_json, write_json
from vg2gt.studies.study import compose_run
from vg2gt.training.loop import build

MIB = 2**20
LOGGED = {"loss": "loss", "gradient_norm": "train/grad_norm", "enhance_point": "train/enhance_point"}


class Watch(lightning.Callback):
    """Summarises windows of steps.

    Args:
        window: steps in one.
        report: called after each with all summaries so far.
    """

    def __init__(self, window: int, report: Callable[[list[dict[str, Any]]], None]) -> None:
        self.window, self.report = window, report
        self.steps: dict[str, list[float]] = {name: [] for name in (*LOGGED, "resident_mib")}
        self.windows: list[dict[str, Any]] = []

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:
        """Takes the step's values, of a dropped one those before it."""
        found = {name: trainer.callback_metrics.get(key) for name, key in LOGGED.items()}
        for name, value in found.items():
            if value is not None:
                self.steps[name].append(float(value))
        self.steps["resident_mib"].append(status("VmRSS") / MIB)
        if trainer.global_step % self.window == 0:
            values = {name: _summary(steps) for name, steps in self.steps.items() if steps}
            self.windows.append({"step": trainer.global_step, **values})
            self.steps = {name: [] for name in self.steps}
            self.report(self.windows)


def _summary(values: list[float]) -> dict[str, float]:
    return {"least": min(values), "median": statistics.median(values), "largest": max(values)}


def main() -> None:
    """Trains and writes."""
    options = parser(__doc__, threads=1, overrides="Hydra overrides")
    options.add_argument("--size", type=int, nargs=2, required=True, metavar=("HEIGHT", "WIDTH"))
    options.add_argument("--views", type=int, required=True)
    options.add_argument("--steps", type=int, default=2000)
    options.add_argument("--window", type=int, default=200)
    arguments = options.parse_args()
    torch.set_num_threads(arguments.threads)
    height, width = arguments.size
    views = [f"data.{name}={arguments.views}" for name in ("min_views", "max_views", "max_images")]
    overrides = [f"data.image_size=[{height},{width}]", *views, f"trainer.max_steps={arguments.steps}"]
    overrides += ["callbacks.checkpoint=null", "logger.csv=null", *arguments.overrides]
    path = dated(arguments.out, "small-images")
    began = time.process_time()

    def report(windows: list[dict[str, Any]]) -> None:
        """Writes what is known so far beside other calls' results."""
        content = read_json(path) if path.is_file() else {"machine": machine(), "runs": {}}
        content["runs"][f"{height}x{width}, {arguments.views} views"] = {
            "command": " ".join(["python", "benchmarks/small_images.py", *sys.argv[1:]]),
            "overrides": overrides,
            "cpu_seconds": time.process_time() - began,
            "dropped_steps": run.module.skipped.total,
            "windows": windows,
        }
        write_json(path, content)

    with tempfile.TemporaryDirectory() as folder:
        run = build(compose_run(overrides, Path(folder)))
        run.trainer.callbacks.append(Watch(arguments.window, report))  # type: ignore[attr-defined]
        run.trainer.fit(run.module, datamodule=run.datamodule)
    print(path)


if __name__ == "__main__":
    main()
