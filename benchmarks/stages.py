"""Inference time by stage: ``python benchmarks/stages.py [--views N] [--size H W] [--device cuda] [overrides]``.

Measures backbone, first decode, coarse voxels, second decode, fine voxels, Gaussian head and rendering of one view, on
a procedural room. Overrides choose model and backend; the paper (Evaluation of Time Consumption) has
``backend=da3_giant model=vg2gt`` and 10 views of 224x448 and 518x518. Times are the best of several passes:
core-seconds on a CPU, CUDA events on a GPU, with the peak memory of each stage. ``trainer.precision`` applies as in
training. With random weights (``backend.pretrained=false``), depth is noise, and so is the number of voxels, which is
printed.

``--training`` also measures a training step and extrapolates to a training of the paper's length. The paper's steps
have 15 images on average, all of them rendered, on each of two devices (``--views 15 experiment=paper data=synthetic
trainer=gpu backend=... model=...``). Prints tables and writes a dated JSON file to ``benchmarks/results``.
"""

from __future__ import annotations

import json
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from common import machine, parser, whole_step, write_results
from stage_clock import StageClock

from vg2gt.evaluation.paper import tables
from vg2gt.evaluation.tables import print_table
from vg2gt.studies.study import compose_run
from vg2gt.training.loop import Run, build
from vg2gt.types import Batch

STAGES = {
    "encode": "backbone",
    "decode": "first decode",
    "coarse": "coarse voxels",
    "decode_again": "second decode",
    "fine": "fine voxels",
    "gaussians": "Gaussian head",
    "render": "render one view",
}
RECONSTRUCTION = tuple(name for name in STAGES if name != "render")
# Seconds from the paper (Evaluation of Time Consumption): 10 images, DA3-GIANT, RTX PRO 6000.
PAPER = {
    (224, 448): {"decode_again": 0.0852, "fine + head": 0.293, "whole": 1.122, "DA3 alone": 0.764},
    (518, 518): {"whole": 2.440, "DA3 alone": 2.180},
}
PAPER_STEPS, PAPER_DEVICES = 420_000, 2


@dataclass(frozen=True)
class Case:
    """A configuration to measure: number of views, image size, Hydra overrides."""

    views: int
    size: tuple[int, int]
    overrides: tuple[str, ...]


def prepare(case: Case, device: torch.device, folder: str) -> tuple[Run, Batch]:
    """Builds the run and loads one scene, both on the device."""
    height, width = case.size
    accelerator = "gpu" if device.type == "cuda" else "cpu"
    scene = [f"data.image_size=[{height},{width}]", "data.eval_scenes=1", "data.train_scenes=1", "data.eval_target=1"]
    scene += [f"data.eval_context={case.views}", f"data.num_frames={case.views + 6}"]
    views = [f"data.min_views={case.views}", f"data.max_views={case.views}", f"data.max_images={case.views}"]
    alone = [f"trainer.accelerator={accelerator}", "trainer.devices=1", "trainer.strategy=auto"]
    config = compose_run([*alone, *scene, *views, *case.overrides], Path(folder))
    run = build(config)
    run.datamodule.setup("validate")
    run.module.to(device)
    return run, next(iter(run.datamodule.val_dataloader())).to(device)


@torch.no_grad()
def measure_inference(run: Run, batch: Batch, passes: int, device: torch.device) -> dict[str, Any]:
    """Measures the best time and largest peak memory of every stage; the first pass is a warm-up."""
    model, clock = run.module.model.eval(), StageClock(device)
    context = batch.context
    for number in range(passes + 1):
        if number == 1:
            clock.stages.clear()
        with clock.listening(), run.trainer.precision_plugin.val_step_context():
            prediction = model(context.images, context.hints)
        cameras = prediction.geometry.cameras.select(slice(0, 1))
        with clock.stage("render"):
            run.module.renderer(prediction.gaussians, cameras)
    pixels = context.depth.numel()
    voxels = None if prediction.voxels is None else len(prediction.voxels.grid)
    return {
        "seconds": {name: clock.stages[name].best for name in STAGES if name in clock.stages},
        "peak_mb": {name: clock.stages[name].memory for name in STAGES if name in clock.stages},
        "gaussians": len(prediction.gaussians),
        "voxels_per_pixel": None if voxels is None else voxels / pixels,
    }


def measure_training(run: Run, batch: Batch, passes: int, device: torch.device) -> float:
    """Measures the best seconds of a training step, without data loading.

    Raises:
        FloatingPointError: if the loss is not finite.
    """
    step, clock = whole_step(run), StageClock(device)
    for _ in range(passes + 1):
        with clock.stage("training step"):
            loss = step(batch)
        if not bool(torch.isfinite(loss)):
            raise FloatingPointError("the loss is not finite: training skips such steps, so they cannot be timed")
    return min(clock.stages["training step"].seconds[1:])


def print_stages(case: Case, result: dict[str, Any], on_gpu: bool) -> None:
    """Prints one row per stage, with the paper's seconds."""
    title = f"{case.views} views of {case.size[0]}x{case.size[1]}, {result['gaussians']:,} Gaussians"
    if result["voxels_per_pixel"] is not None:
        title += f", {result['voxels_per_pixel']:.2f} voxels per pixel"
    seconds, peaks = result["seconds"], result["peak_mb"]
    paper = PAPER.get(case.size, {}) if case.views == 10 else {}
    whole = sum(seconds[name] for name in RECONSTRUCTION if name in seconds)
    head, backbone = seconds.get("fine", 0.0) + seconds["gaussians"], seconds["encode"] + seconds["decode"]
    shown = [(STAGES[name], seconds[name], peaks[name], paper.get(name)) for name in seconds]
    shown += [
        ("fine voxels and Gaussian head", head, 0.0, paper.get("fine + head")),
        ("backbone and first decode alone", backbone, 0.0, paper.get("DA3 alone")),
        ("whole reconstruction", whole, max(peaks.values()), paper.get("whole")),
    ]
    rows = []
    for name, value, peak, theirs in shown:
        memory = [f"{peak:.0f}" if peak else ""] if on_gpu else []
        rows.append([name, f"{value:.4f}", f"{value / whole:.0%}", *memory, f"{theirs:g}" if theirs else ""])
    headings = ["stage", "seconds", "share", *(["peak MB"] if on_gpu else []), "paper, s"]
    caption = "paper: DA3-GIANT with model=vg2gt's widths on an RTX PRO 6000"
    print_table(headings, rows, title=title, caption=caption)


def paper_training_hours(step_seconds: float) -> float:
    """Returns the device hours of a training with the paper's numbers of steps and devices."""
    return step_seconds * PAPER_STEPS * PAPER_DEVICES / 3600


def print_training(run: Run, case: Case, step_seconds: float, where: str) -> None:
    """Prints the hours of a training of the paper's length on this machine, with the paper's table."""
    rendered = min(case.views, run.module.render_views or case.views)
    title = (
        f"training cost: {PAPER_STEPS:,} steps of {step_seconds:.3f} s on {PAPER_DEVICES} devices, each step "
        f"{case.views} images, {rendered} of them rendered (paper: 15 in the mean, all rendered)"
    )
    rows = [["measured here", where, f"{paper_training_hours(step_seconds):,.1f}", "n/a"]]
    for name, cost in tables()["tbl_training_cost"].items():
        rows.append([f"{name} (paper)", cost["gpu"], f"{cost['hours']:,.0f}", f"{cost['converted_hours']:,.1f}"])
    print_table(("method", "device", "device hours", "hours on the paper's GPU"), rows, title=title, text_columns=2)


def main() -> None:
    """Measures, prints and writes."""
    options = parser(__doc__, device=True, threads=1, passes=3, overrides="Hydra overrides")
    options.add_argument("--views", type=int, default=10)
    options.add_argument("--size", type=int, nargs=2, action="append", metavar=("H", "W"))
    options.add_argument("--training", action="store_true", help="measure a training step as well")
    arguments = options.parse_args()
    torch.set_num_threads(arguments.threads)
    device = torch.device(arguments.device)
    where, load = machine(device), round(os.getloadavg()[0], 2)
    print(json.dumps(where))
    model = next((text.removeprefix("model=") for text in arguments.overrides if text.startswith("model=")), "tiny")
    cases, backend, precision = [], "", ""
    for size in arguments.size or [[224, 448], [518, 518]]:
        case = Case(arguments.views, (size[0], size[1]), tuple(arguments.overrides))
        with tempfile.TemporaryDirectory() as folder:
            run, batch = prepare(case, device, folder)
            result = measure_inference(run, batch, arguments.passes, device)
            print_stages(case, result, device.type == "cuda")
            if arguments.training:
                result["training_step"] = measure_training(run, batch.context, arguments.passes, device)
                result["rendered_in_training"] = min(case.views, run.module.render_views or case.views)
                print_training(run, case, result["training_step"], str(where.get("gpu", where["processor"])))
        cases.append({"views": case.views, "size": list(case.size), **result})
        backend, precision = run.module.model.backend.name, str(run.trainer.precision)
    content = {
        "machine": where,
        "unit": "seconds" if device.type == "cuda" else "core-seconds",
        "threads": arguments.threads,
        "load at the beginning": load,
        "backend": backend,
        "model": model,
        "precision": precision,
        "overrides": arguments.overrides,
        "passes": arguments.passes,
        "cases": cases,
    }
    write_results(arguments.out, f"stages-{backend}-{model}-{device.type}", content)


if __name__ == "__main__":
    main()
