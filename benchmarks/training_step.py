"""Where the time of a training step goes: ``python benchmarks/training_step.py [--steps N] [--threads N] [overrides]``.

Runs the default configuration (or any other, by overrides) for a few steps and sums the time of the stages that the
model and the training step mark. Writes a dated JSON file to ``benchmarks/results`` and prints a table.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from datetime import date
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from machine import machine
from rich.console import Console
from rich.table import Table

from vg2gt.config import config_dir
from vg2gt.io.files import write_json
from vg2gt.training.loop import build

STAGES = {
    "backbone (encode)": "vg2gt/encode",
    "first decode": "vg2gt/decode",
    "coarse voxels": "vg2gt/coarse",
    "second decode": "vg2gt/decode_again",
    "fine voxels": "vg2gt/fine",
    "Gaussian head": "vg2gt/gaussians",
    "render": "vg2gt/render",
    "loss": "vg2gt/loss",
}


def measure(overrides: list[str], warmup: int, steps: int) -> dict[str, float]:
    """Returns seconds a step for every stage, ``backward`` and ``whole step`` (wall clock)."""
    with tempfile.TemporaryDirectory() as folder:
        with initialize_config_dir(config_dir(), version_base="1.3"):
            config = compose("train", [f"output_dir={folder}", "hydra/job_logging=default", *overrides])
        run = build(config)
        run.datamodule.setup("fit")
        module = run.module.train()
        run.trainer.strategy.connect(module)
        module.log = lambda *args, **kwargs: None  # type: ignore[method-assign]
        batches = iter(run.datamodule.train_dataloader())
        optimizer = torch.optim.AdamW(module.model.trained_parameters(), lr=1e-4)
        totals = dict.fromkeys([*STAGES, "backward", "optimizer", "whole step"], 0.0)
        for step in range(warmup + steps):
            batch = next(batches)
            # The profiler slows a step down: stages are timed in one pass, the step and its backward in another.
            with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
                module.training_step(batch, step)
            started = time.perf_counter()
            loss = module.training_step(batch, step)
            forward_done = time.perf_counter()
            loss.backward()
            backward_done = time.perf_counter()
            optimizer.step()
            optimizer.zero_grad()
            ended = time.perf_counter()
            if step < warmup:
                continue
            totals["backward"] += backward_done - forward_done
            totals["optimizer"] += ended - backward_done
            totals["whole step"] += ended - started
            events = {event.key: event.cpu_time_total * 1e-6 for event in profile.key_averages()}
            for stage, key in STAGES.items():
                totals[stage] += events.get(key, 0.0)
    return {stage: total / steps for stage, total in totals.items()}


def main() -> None:
    """Measures, prints and writes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--warmup", type=int, default=3)
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("overrides", nargs="*", help="Hydra overrides")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    seconds = measure(arguments.overrides, arguments.warmup, arguments.steps)

    table = Table(title=f"seconds a training step, {arguments.threads} threads")
    for heading in ("stage", "seconds", "share"):
        table.add_column(heading, justify="left" if heading == "stage" else "right")
    for stage, value in seconds.items():
        table.add_row(stage, f"{value:.3f}", f"{value / seconds['whole step']:.0%}")
    Console().print(table)
    result = {
        "seconds": seconds,
        "threads": arguments.threads,
        "overrides": arguments.overrides,
        "steps": arguments.steps,
        "machine": machine(),
    }
    path = arguments.out / f"{date.today().isoformat()}-training-step.json"
    print(write_json(path, result))


if __name__ == "__main__":
    main()
