"""A backend's time and peak memory against the number of views: ``python benchmarks/backend_views.py``.

The weights are random, nothing is downloaded. Every view count runs in a process of its own, so that no peak contains
another's. Three stages: ``encode``, ``decode`` without gradient, and ``decode + backward`` to the patch tokens. Times
are the best of several passes: core-seconds on a CPU, seconds on a GPU (the clock's time stands in the file as well).
Memory is what the first pass of a stage reaches above the network and the images: resident memory on a CPU, which
includes what the allocator has not given back, allocated memory on a GPU. Prints tables and writes a dated JSON file.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import TypeVar

import torch
from common import PeakMemory, machine, parser, used_seconds, write_results
from hydra.utils import instantiate
from omegaconf import DictConfig
from render_scene import room_cameras

from backends.base import Backend
from vg2gt import __version__
from vg2gt.config import compose
from vg2gt.evaluation.tables import print_table
from vg2gt.types import Hints, Tokens

Result = TypeVar("Result")


@dataclass
class Stage:
    """Best times in seconds (``seconds``: of all cores on a CPU; ``wall``: by the clock) and the peak in MB."""

    seconds: float = float("inf")
    wall: float = float("inf")
    peak_mb: float = 0.0


def build(name: str, device: torch.device) -> Backend:
    """The backend of ``configs/backend`` with random weights.

    Raises:
        ValueError: if it has no weights that could be random.
    """
    config = compose("train", f"backend={name}").backend
    parts = [config, *(part for part in config.values() if isinstance(part, DictConfig))]  # nested: two networks
    parts = [part for part in parts if "pretrained" in part]
    if not parts:
        raise ValueError(f"backend {name} has no option pretrained, so no random weights: choose da3_* or vggt_*")
    for part in parts:
        part.pretrained = False
    return instantiate(config).to(device)


def measure(backend: Backend, views: int, size: tuple[int, int], passes: int, device: torch.device) -> dict[str, Stage]:
    """Runs the stages in turn on random images; the first pass gives the peaks, the others the times."""
    generator = torch.Generator().manual_seed(0)
    images = torch.rand(1, views, 3, *size, generator=generator).to(device)
    hints = Hints(cameras=room_cameras(views, size).to(device))
    edge = (backend.patch_size, backend.patch_size)
    small = backend.encode(torch.rand(1, 1, 3, *edge, device=device), Hints(cameras=room_cameras(1, edge).to(device)))
    _decode_and_backward(backend, small)  # starts the libraries, whose own memory is not the backend's
    del small
    memory = PeakMemory(device)
    stages = {name: Stage() for name in ("encode", "decode", "decode + backward")}
    for number in range(passes + 1):
        tokens = _run(stages["encode"], lambda: backend.encode(images, hints), number, memory)
        _run(stages["decode"], lambda tokens=tokens: _decode(backend, tokens), number, memory)
        _run(stages["decode + backward"], lambda tokens=tokens: _decode_and_backward(backend, tokens), number, memory)
        del tokens
    return stages


def _run(stage: Stage, function: Callable[[], Result], number: int, memory: PeakMemory) -> Result:
    memory.restart()
    used, clock = used_seconds(memory.device), time.perf_counter()
    result = function()
    used, clock = used_seconds(memory.device) - used, time.perf_counter() - clock
    if number == 0:
        stage.peak_mb = memory.megabytes
    else:
        stage.seconds, stage.wall = min(stage.seconds, used), min(stage.wall, clock)
    return result


@torch.no_grad()
def _decode(backend: Backend, tokens: Tokens) -> None:
    backend.decode(tokens)


def _decode_and_backward(backend: Backend, tokens: Tokens) -> None:
    patch = tuple(tap.detach().requires_grad_() for tap in tokens.patch)
    geometry = backend.decode(tokens.with_patch(patch))
    torch.autograd.grad(geometry.depth.mean() + geometry.depth_conf.mean(), patch)


def measure_apart(arguments: argparse.Namespace, views: int) -> dict[str, Stage]:
    """Measures one view count in a process of its own."""
    command = [sys.executable, __file__, "--backend", arguments.backend, "--device", arguments.device]
    command += ["--size", *map(str, arguments.size), "--threads", str(arguments.threads)]
    command += ["--passes", str(arguments.passes), "--views", str(views), "--child"]
    printed = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    return {name: Stage(**stage) for name, stage in json.loads(printed.splitlines()[-1]).items()}


def print_tables(title: str, results: dict[int, dict[str, Stage]]) -> None:
    """One table per stage: one row per view count, with the ratios to the smallest."""
    head = ("views", "seconds", "ratio", "seconds per view", "peak MB", "ratio")
    for name, first in results[min(results)].items():
        rows = []
        for views, stages in sorted(results.items()):
            stage = stages[name]
            row = [str(views), f"{stage.seconds:.3f}", f"{stage.seconds / first.seconds:.2f}"]
            row += [f"{stage.seconds / views:.3f}", f"{stage.peak_mb:.0f}", f"{stage.peak_mb / first.peak_mb:.2f}"]
            rows.append(row)
        print_table(head, rows, title=f"{name}, {title}", text_columns=0)


def main() -> None:
    """Measures, prints and writes."""
    options = parser(__doc__, device=True, threads=1, passes=3)
    options.add_argument("--backend", default="da3_small", help="a name in configs/backend")
    options.add_argument("--views", type=int, nargs="+", default=[1, 2, 4, 8, 16])
    options.add_argument("--size", type=int, nargs=2, default=[112, 224], metavar=("HEIGHT", "WIDTH"))
    options.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    arguments = options.parse_args()
    device, size = torch.device(arguments.device), (arguments.size[0], arguments.size[1])
    torch.set_num_threads(arguments.threads)
    if arguments.child:
        stages = measure(build(arguments.backend, device), arguments.views[0], size, arguments.passes, device)
        print(json.dumps({name: asdict(stage) for name, stage in stages.items()}))
        return
    results = {views: measure_apart(arguments, views) for views in sorted(set(arguments.views))}
    print_tables(f"{arguments.backend}, {size[0]}x{size[1]}, {device.type}, {arguments.threads} threads", results)
    content = {
        "machine": machine(device) | {"vg2gt": __version__},
        "backend": arguments.backend,
        "device": device.type,
        "size": size,
        "threads": arguments.threads,
        "passes": arguments.passes,
        "views": {views: {name: asdict(stage) for name, stage in stages.items()} for views, stages in results.items()},
    }
    write_results(arguments.out, f"backends-{arguments.backend}-{device.type}", content)


if __name__ == "__main__":
    main()
