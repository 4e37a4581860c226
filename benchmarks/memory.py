"""Peak memory against views, voxels and Gaussians: ``python benchmarks/memory.py [--models NAME ...] [--device cuda]``.

Forward only, and a whole training step (reconstruction, rendering, losses, backward pass, optimiser), of a procedural
scene, for two configurations: ``tiny`` is the default one (``backend=oracle model=tiny``, 112x112), ``paper`` has the
paper's modules at their sizes on a small backbone with random weights (``backend=da3_small model=vg2gt``, 112x224).
Views are varied alone, then voxels by ``model.fine.max_voxels`` and Gaussians by ``model.gaussians.splits``.

On a CPU (Linux) every point is measured in a process of its own, as the largest resident set (VmHWM): before the
pass, at its peak, and the difference. On a GPU it is ``torch.cuda.max_memory_allocated``. Writes a dated JSON file and
a Markdown table to ``benchmarks/results``.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import logging
import multiprocessing
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import date
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch
from machine import machine
from stages import Case, prepare

from vg2gt.io.files import write_json, write_text
from vg2gt.training.loop import Run
from vg2gt.types import Batch

MIB = 2**20
MODES = ("forward", "training")


@dataclass(frozen=True)
class Model:
    """A configuration and the points at which it is measured.

    Attributes:
        size: of the images, ``(height, width)``.
        overrides: Hydra overrides.
        views: numbers of views, measured alone; the last is also that of the other points.
        voxels: values of ``model.fine.max_voxels``.
        splits: values of ``model.gaussians.splits``.
    """

    size: tuple[int, int]
    overrides: tuple[str, ...]
    views: tuple[int, ...]
    voxels: tuple[int, ...]
    splits: tuple[int, ...]

    def points(self) -> list[Point]:
        """What is measured, in the order of the table."""
        most = self.views[-1]
        points = [Point("views", views) for views in self.views]
        points += [Point("voxels", most, (f"model.fine.max_voxels={count}",)) for count in self.voxels]
        return points + [Point("Gaussians", most, (f"model.gaussians.splits={count}",)) for count in self.splits]


@dataclass(frozen=True)
class Point:
    """One line of the table: what is varied, the number of views, overrides."""

    varied: str
    views: int
    overrides: tuple[str, ...] = field(default=())


MODELS = {
    "tiny": Model((112, 112), (), (2, 4, 8, 16), (1_000, 10_000, 50_000), (1, 4, 8)),
    "paper": Model(
        (112, 224), ("backend=da3_small", "backend.pretrained=false", "model=vg2gt"), (2, 4), (1_000,), (1, 4)
    ),
}


def measure(model: Model, point: Point, mode: str, device: torch.device) -> dict[str, Any]:
    """Peak memory of one pass, MiB; on a CPU of this process, which should do nothing else."""
    with tempfile.TemporaryDirectory() as folder:
        overrides = (*model.overrides, *point.overrides)
        run, batch = prepare(Case(point.views, model.size, overrides), device, folder)
        step = _training_step if mode == "training" else _forward
        gc.collect()
        before = _begin(device)
        sizes = step(run, batch)
        peak = _peak(device)
    return {"before_mib": before, "peak_mib": peak, "pass_mib": peak - before, **sizes}


def _forward(run: Run, batch: Batch) -> dict[str, int]:
    model, context = run.module.model.eval(), batch.context
    with torch.no_grad():
        prediction = model(context.images, context.hints)
        run.module.renderer(prediction.gaussians, prediction.geometry.cameras.select(slice(0, 1)))
    voxels = 0 if prediction.voxels is None else len(prediction.voxels.grid)
    return {"voxels": voxels, "gaussians": len(prediction.gaussians)}


def _training_step(run: Run, batch: Batch) -> dict[str, int]:
    module, sizes = run.module.train(), {}
    run.trainer.strategy.connect(module)
    module.log = lambda *args, **kwargs: None  # type: ignore[method-assign]

    def note(_: Any, __: Any, prediction: Any) -> None:
        sizes["voxels"] = 0 if prediction.voxels is None else len(prediction.voxels.grid)
        sizes["gaussians"] = len(prediction.gaussians)

    module.model.register_forward_hook(note)
    module.training_step(batch.context, 0).backward()
    module.make_optimizer(module.model.trained_parameters()).step()
    return sizes


def _begin(device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)
        return torch.cuda.memory_allocated(device) / MIB
    # What building and loading have freed goes back to the system, or the pass would be served from it unseen.
    ctypes.CDLL(None).malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5")  # sets the high-water mark to what is resident now
    return _status("VmRSS")


def _peak(device: torch.device) -> float:
    return torch.cuda.max_memory_allocated(device) / MIB if device.type == "cuda" else _status("VmHWM")


def _status(name: str) -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(f"{name}:"))


def in_a_child(model: Model, point: Point, mode: str, device: torch.device) -> dict[str, Any]:
    """:func:`measure` in a forked process, so that no point finds what another one left in the allocator."""
    context = multiprocessing.get_context("fork")
    receive, send = context.Pipe(duplex=False)

    def work(connection: Connection) -> None:
        torch.set_num_threads(1)
        connection.send(measure(model, point, mode, device))

    child = context.Process(target=work, args=(send,))
    child.start()
    send.close()
    try:
        return receive.recv()
    except EOFError:
        return {"failed": "the process ended without a result; memory was probably full"}
    finally:
        child.join()


def markdown(rows: Sequence[dict[str, Any]], where: dict[str, Any]) -> str:
    """A table a configuration."""
    lines = [f"Peak memory in MiB; {where.get('gpu', where['processor'])}, torch {where['torch']}.", ""]
    for name in dict.fromkeys(row["model"] for row in rows):
        height, width = MODELS[name].size
        lines += [f"`{name}`, {height}x{width}: {' '.join(MODELS[name].overrides) or 'defaults'}", ""]
        lines += [
            "| varied | views | voxels | Gaussians | forward: peak | of it the pass | training: peak | of it the step |"
        ]
        lines += ["|---|---:|---:|---:|---:|---:|---:|---:|"]
        for row in (row for row in rows if row["model"] == name):
            figures = []
            for mode in MODES:
                found = row.get(mode, {})
                figures += [f"{found[key]:,.0f}" if key in found else "n/a" for key in ("peak_mib", "pass_mib")]
            sizes = row.get("forward") or row.get("training") or {}
            counts = [f"{sizes[key]:,}" if key in sizes else "n/a" for key in ("voxels", "gaussians")]
            lines.append(f"| {' | '.join((row['varied'], str(row['views']), *counts, *figures))} |")
        lines.append("")
    return "\n".join(lines)


def main() -> None:
    """Measures, prints and writes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", nargs="+", choices=MODELS, default=list(MODELS))
    parser.add_argument("--modes", nargs="+", choices=MODES, default=list(MODES))
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    logging.disable(logging.WARNING)  # the limits say what they drop
    device = torch.device(arguments.device)
    run = measure if device.type == "cuda" else in_a_child
    if device.type == "cpu":  # what is imported and compiled once is no part of any point
        for mode in arguments.modes:
            measure(MODELS["tiny"], Point("views", 2), mode, device)
    where, rows = machine(device), []
    stem = arguments.out / f"{date.today().isoformat()}-memory-{device.type}"
    for name in arguments.models:
        for point in MODELS[name].points():
            row: dict[str, Any] = {"model": name, "varied": point.varied, "views": point.views}
            row["overrides"] = list(point.overrides)
            for mode in arguments.modes:
                row[mode] = run(MODELS[name], point, mode, device)
            rows.append(row)
            print(row, flush=True)
            write_json(f"{stem}.json", {"machine": where, "unit": "MiB", "threads": 1, "points": rows})
            write_text(f"{stem}.md", markdown(rows, where))
    print(markdown(rows, where))
    print(f"{stem}.json, {stem}.md")


if __name__ == "__main__":
    main()
