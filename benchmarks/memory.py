"""Peak memory by views, voxels and Gaussians: ``python benchmarks/memory.py [--models NAME ...] [--device cuda]``.

Measures the forward pass alone, and a whole training step (reconstruction, rendering, losses, backward pass,
optimiser), on a procedural scene. There are two configurations: ``tiny`` is the default (``backend=oracle model=tiny``,
112x112), ``paper`` has the paper's modules at full size on a small backbone with random weights (``backend=da3_small
model=vg2gt``, 112x224). Varies the number of views, then voxels with ``model.fine.max_voxels`` and Gaussians with
``model.gaussians.splits``.

On a CPU (Linux), every point is measured in a separate process, as the resident set (VmHWM): before the pass, at its
peak, and the difference. On a GPU, it is ``torch.cuda.max_memory_allocated``. Prints a table and writes a dated JSON
file to ``benchmarks/results``.
"""

from __future__ import annotations

import gc
import logging
import multiprocessing
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

import torch
from common import PeakMemory, machine, parser, training_step, write_results
from stages import Case, prepare

from vg2gt.evaluation.tables import markdown_table
from vg2gt.training.loop import Run
from vg2gt.types import Batch, Prediction

MIB = 2**20
MODES = ("forward", "training")


@dataclass(frozen=True)
class Model:
    """A configuration and its measurement points.

    Attributes:
        size: image ``(height, width)``.
        overrides: Hydra overrides.
        views: numbers of views to measure; the last is used for all other points.
        voxels: values of ``model.fine.max_voxels``.
        splits: values of ``model.gaussians.splits``.
    """

    size: tuple[int, int]
    overrides: tuple[str, ...]
    views: tuple[int, ...]
    voxels: tuple[int, ...]
    splits: tuple[int, ...]

    def points(self) -> list[Point]:
        """Returns the measurement points, in the order of the table."""
        most = self.views[-1]
        points = [Point("views", views) for views in self.views]
        points += [Point("voxels", most, (f"model.fine.max_voxels={count}",)) for count in self.voxels]
        return points + [Point("Gaussians", most, (f"model.gaussians.splits={count}",)) for count in self.splits]


@dataclass(frozen=True)
class Point:
    """A row of the table: the varied quantity, number of views, overrides."""

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
    """Measures peak memory of one pass in MiB; on a CPU that of the whole process, which should do nothing else."""
    with tempfile.TemporaryDirectory() as folder:
        overrides = (*model.overrides, *point.overrides)
        run, batch = prepare(Case(point.views, model.size, overrides), device, folder)
        step = _training_step if mode == "training" else _forward
        gc.collect()
        memory = PeakMemory(device)
        sizes = step(run, batch)
        before, peak = memory.start / MIB, memory.peak / MIB
    return {"before_mib": before, "peak_mib": peak, "pass_mib": peak - before, **sizes}


def _forward(run: Run, batch: Batch) -> dict[str, int]:
    model, context = run.module.model.eval(), batch.context
    with torch.no_grad():
        prediction = model(context.images, context.hints)
        run.module.renderer(prediction.gaussians, prediction.geometry.cameras.select(slice(0, 1)))
    return _sizes(prediction)


def _training_step(run: Run, batch: Batch) -> dict[str, int]:
    module, step_loss, sizes = run.module, training_step(run), {}
    module.model.register_forward_hook(lambda _, __, prediction: sizes.update(_sizes(prediction)))
    step_loss(batch.context).backward()
    module.make_optimizer(module.model.trained_parameters()).step()
    return sizes


def _sizes(prediction: Prediction) -> dict[str, int]:
    voxels = 0 if prediction.voxels is None else len(prediction.voxels.grid)
    return {"voxels": voxels, "gaussians": len(prediction.gaussians)}


def in_a_child(model: Model, point: Point, mode: str, device: torch.device) -> dict[str, Any]:
    """Runs :func:`measure` in a forked process, so that points do not share allocator state."""
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
    """Returns one Markdown table per configuration."""
    head = ["varied", "views", "voxels", "Gaussians"]
    head += ["forward: peak", "of it the pass", "training: peak", "of it the step"]
    lines = [f"Peak memory in MiB; {where.get('gpu', where['processor'])}, torch {where['torch']}.", ""]
    for name in dict.fromkeys(row["model"] for row in rows):
        height, width = MODELS[name].size
        lines += [f"`{name}`, {height}x{width}: {' '.join(MODELS[name].overrides) or 'defaults'}", ""]
        lines += [markdown_table(head, [_cells(row) for row in rows if row["model"] == name]), ""]
    return "\n".join(lines)


def _cells(row: dict[str, Any]) -> list[str]:
    sizes = row.get("forward") or row.get("training") or {}
    counts = [f"{sizes[key]:,}" if key in sizes else "n/a" for key in ("voxels", "gaussians")]
    found = [(row.get(mode, {}), key) for mode in MODES for key in ("peak_mib", "pass_mib")]
    return [row["varied"], str(row["views"]), *counts, *(f"{f[key]:,.0f}" if key in f else "n/a" for f, key in found)]


def main() -> None:
    """Measures, prints and writes."""
    options = parser(__doc__)
    options.add_argument("--models", nargs="+", choices=MODELS, default=list(MODELS))
    options.add_argument("--modes", nargs="+", choices=MODES, default=list(MODES))
    options.add_argument("--device", default="cpu")
    arguments = options.parse_args()
    torch.set_num_threads(1)
    logging.disable(logging.WARNING)  # limits log what they drop
    device = torch.device(arguments.device)
    run = measure if device.type == "cuda" else in_a_child
    if device.type == "cpu":  # warm-up: imports and compilation belong to no point
        for mode in arguments.modes:
            measure(MODELS["tiny"], Point("views", 2), mode, device)
    where, rows = machine(device), []
    for name in arguments.models:
        for point in MODELS[name].points():
            row: dict[str, Any] = {"model": name, "varied": point.varied, "views": point.views}
            row["overrides"] = list(point.overrides)
            for mode in arguments.modes:
                row[mode] = run(MODELS[name], point, mode, device)
            rows.append(row)
            print(row, flush=True)
            content = {"machine": where, "unit": "MiB", "threads": 1, "points": rows}
            write_results(arguments.out, f"memory-{device.type}", content)
    print(markdown(rows, where))


if __name__ == "__main__":
    main()
