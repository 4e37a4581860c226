"""Where the time of a training step goes: ``python benchmarks/training_step.py [--steps N] [--threads N] [overrides]``.

Runs the default configuration (or any other, by overrides) for a few steps and sums the time of the stages that the
model and the training step mark. Writes a dated JSON file to ``benchmarks/results`` and prints a table.
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

import torch
from common import machine, parser, training_step, write_results
from stage_clock import StageClock

from vg2gt.evaluation.tables import print_table
from vg2gt.studies.study import compose_run
from vg2gt.training.loop import build

STAGES = {
    "backbone (encode)": "encode",
    "first decode": "decode",
    "coarse voxels": "coarse",
    "second decode": "decode_again",
    "fine voxels": "fine",
    "Gaussian head": "gaussians",
    "cameras of held-out views": "cameras",
    "render": "render",
    "loss": "loss",
}


def measure(overrides: list[str], warmup: int, steps: int) -> dict[str, float]:
    """Returns seconds per step for every stage, ``backward``, ``optimizer`` and ``whole step``, by the clock."""
    with tempfile.TemporaryDirectory() as folder:
        run = build(compose_run(overrides, Path(folder)))
        run.datamodule.setup("fit")
        step_loss, batches = training_step(run), iter(run.datamodule.train_dataloader())
        optimizer = torch.optim.AdamW(run.module.model.trained_parameters(), lr=1e-4)
        clock = StageClock(torch.device("cpu"), now=time.perf_counter)
        for step in range(warmup + steps):
            if step == warmup:
                clock.stages.clear()
            batch = next(batches)
            with clock.stage("whole step"):
                with clock.listening():
                    loss = step_loss(batch)
                with clock.stage("backward"):
                    loss.backward()
                with clock.stage("optimizer"):
                    optimizer.step()
                    optimizer.zero_grad()
    names = {**STAGES, **{name: name for name in ("backward", "optimizer", "whole step")}}
    return {shown: sum(clock.stages[name].seconds) / steps for shown, name in names.items() if name in clock.stages}


def main() -> None:
    """Measures, prints and writes."""
    options = parser(__doc__, threads=os.cpu_count() or 1, overrides="Hydra overrides")
    options.add_argument("--steps", type=int, default=20)
    options.add_argument("--warmup", type=int, default=3)
    arguments = options.parse_args()
    torch.set_num_threads(arguments.threads)
    seconds = measure(arguments.overrides, arguments.warmup, arguments.steps)
    rows = [[stage, f"{value:.3f}", f"{value / seconds['whole step']:.0%}"] for stage, value in seconds.items()]
    print_table(("stage", "seconds", "share"), rows, title=f"seconds per training step, {arguments.threads} threads")
    content = {
        "seconds": seconds,
        "threads": arguments.threads,
        "overrides": arguments.overrides,
        "steps": arguments.steps,
        "machine": machine(),
    }
    write_results(arguments.out, "training-step", content)


if __name__ == "__main__":
    main()
