"""Speed, and on a GPU memory, of the renderer's implementations: ``python benchmarks/render.py [--device cuda]``.

Measures all implementations alternately in one process and compares them by ratio. Times are the best of several
passes: core-milliseconds on a CPU (with one thread unless the table says otherwise), milliseconds on a GPU. Prints
tables and writes a dated JSON file to ``benchmarks/results``.
"""

from __future__ import annotations

import json
import os
import time
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from common import MEGABYTE, machine, parser, used_seconds, write_results
from render_scene import room_cameras, room_gaussians
from torch import Tensor

from vg2gt.evaluation.tables import print_table
from vg2gt.rendering import render
from vg2gt.types import Cameras, Gaussians

PARAMETERS = ("means", "quats", "scales", "opacities", "sh")


@dataclass(frozen=True)
class Case:
    """One measurement."""

    implementation: str
    gaussians: int
    size: tuple[int, int] = (224, 448)
    views: int = 1
    mode: str = "solid"
    geometry: bool = True
    threads: int = 1
    sigma: float = 1.0

    @property
    def scene(self) -> tuple[Any, ...]:
        """Properties that cases must share to be compared."""
        return self.gaussians, self.size, self.views


@dataclass
class Timing:
    """Best times of a case in milliseconds (``wall`` is wall time of both passes), and peak GPU memory in MB."""

    forward: float = float("inf")
    backward: float = float("inf")
    wall: float = float("inf")
    memory: float = 0.0

    @property
    def total(self) -> float:
        """Sum of forward and backward."""
        return self.forward + self.backward


def build(case: Case, device: torch.device) -> tuple[Gaussians, Cameras]:
    """Returns the case's scene on the device; its parameters require gradients."""
    gaussians = room_gaussians(case.gaussians, case.size, case.sigma).to(device)
    gaussians = gaussians.map(lambda t: t.requires_grad_() if t.is_floating_point() else t)
    return gaussians, room_cameras(case.views, case.size).to(device)


def measure_once(case: Case, gaussians: Gaussians, cameras: Cameras) -> Timing:
    """Times one forward and one backward pass with random incoming gradients."""
    torch.set_num_threads(case.threads)
    device = cameras.intrinsics.device
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
    start, clock = used_seconds(device), time.perf_counter()
    outputs = _run(case, gaussians, cameras)
    middle, forward_wall = used_seconds(device), time.perf_counter() - clock
    weights = [torch.randn_like(output) for output in outputs]
    resume, clock = used_seconds(device), time.perf_counter()
    torch.autograd.grad(outputs, [getattr(gaussians, name) for name in PARAMETERS], weights, allow_unused=True)
    end = used_seconds(device)
    wall = 1e3 * (forward_wall + time.perf_counter() - clock)
    memory = (torch.cuda.max_memory_allocated(device) - before) / MEGABYTE if device.type == "cuda" else 0.0
    return Timing(1e3 * (middle - start), 1e3 * (end - resume), wall, memory)


def _run(case: Case, gaussians: Gaussians, cameras: Cameras) -> list[Tensor]:
    if case.implementation == "gsplat":
        return _run_gsplat(gaussians, cameras)
    out = render(
        gaussians,
        cameras,
        case.mode,  # type: ignore[arg-type]
        implementation=case.implementation,  # type: ignore[arg-type]
        geometry=case.geometry,
    )
    return [out.color, out.depth, out.normal, out.alpha] if case.geometry else [out.color]


def _run_gsplat(gaussians: Gaussians, cameras: Cameras) -> list[Tensor]:
    """Renders colour and expected depth with gsplat's rasteriser."""
    from gsplat import rasterization  # pyright: ignore[reportMissingImports]

    height, width = cameras.size
    colors, alphas, _ = rasterization(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
        cameras.world_to_camera[0],
        cameras.intrinsics[0],
        width,
        height,
        sh_degree=0,
        render_mode="RGB+ED",
    )
    return [colors, alphas]


def compare(cases: list[Case], device: torch.device, passes: int) -> list[Timing]:
    """Measures the cases alternately; the first pass is a warm-up."""
    scenes = {}
    for case in cases:
        key = (case.gaussians, case.size, case.views, case.sigma)
        if key not in scenes:
            scenes[key] = build(case, device)
    best = [Timing() for _ in cases]
    for number in range(passes + 1):
        for case, timing in zip(cases, best, strict=True):
            slow = case.implementation == "dense"
            if slow and number > 1:
                continue
            once = measure_once(case, *scenes[(case.gaussians, case.size, case.views, case.sigma)])
            if number > 0:
                timing.forward = min(timing.forward, once.forward)
                timing.backward = min(timing.backward, once.backward)
                timing.wall = min(timing.wall, once.wall)
                timing.memory = max(timing.memory, once.memory)
    return best


def cpu_suites(quick: bool) -> dict[str, list[Case]]:
    """Returns the cases for a CPU, by table."""
    base = Case("cpu", 100_000)
    cores = os.cpu_count() or 1
    suites = {
        "implementations": [
            replace(base, gaussians=1_500, size=(40, 80), sigma=1.2, implementation=name)
            for name in ("cpu", "torch", "dense")
        ],
        "outputs": [
            base,
            replace(base, geometry=False),
            replace(base, mode="rasterized"),
            replace(base, mode="rasterized", geometry=False),
        ],
    }
    if quick:
        return suites
    for count in (20_000, 100_000):
        sigma = 2.0 if count == 20_000 else 1.0
        suites["implementations"] += [
            replace(base, gaussians=count, sigma=sigma, implementation=name) for name in ("cpu", "torch")
        ]
    suites["Gaussians"] = [replace(base, gaussians=n) for n in (10_000, 30_000, 100_000, 300_000)]
    suites["views"] = [replace(base, gaussians=30_000, views=v) for v in (1, 2, 4, 8)]
    suites["threads"] = [replace(base, views=2, threads=t) for t in sorted({1, 2, cores // 2, cores} - {0})]
    return suites


def gpu_suites(quick: bool) -> dict[str, list[Case]]:
    """Returns the cases for a GPU, by table; includes gsplat if installed."""
    try:
        import gsplat  # noqa: F401  # pyright: ignore[reportMissingImports]

        names = ("triton", "torch", "gsplat")
    except ImportError:
        names = ("triton", "torch")
    sizes = ((224, 448),) if quick else ((224, 448), (518, 518))
    counts, views = ((100_000,), (1, 8)) if quick else ((100_000, 1_000_000), (1, 8, 18))
    base = Case("triton", 100_000)
    return {
        f"{height} x {width}": [
            replace(base, implementation=name, gaussians=count, size=(height, width), views=number)
            for count in counts
            for number in views
            for name in names
            if not (name == "torch" and count * number > 1_000_000)
        ]
        for height, width in sizes
    }


def print_case_table(title: str, cases: list[Case], timings: list[Timing], unit: str) -> None:
    """Prints one row per case, with its ratio to the first case of the same scene."""
    head = ["implementation", "mode", "outputs", "Gaussians", "size", "views", "threads"]
    head += ["forward", "backward", "total", "ratio", "wall"]
    if with_memory := any(timing.memory for timing in timings):
        head.append("peak MB")
    first: dict[tuple[Any, ...], float] = {}
    rows = []
    for case, timing in zip(cases, timings, strict=True):
        reference = first.setdefault(case.scene, timing.total)
        row = [case.implementation, case.mode, "all" if case.geometry else "colour", f"{case.gaussians:,}"]
        row += [f"{case.size[0]}x{case.size[1]}", str(case.views), str(case.threads)]
        row += [f"{value:.1f}" for value in (timing.forward, timing.backward, timing.total)]
        row += [f"{timing.total / reference:.2f}", f"{timing.wall:.1f}"]
        rows.append(row + ([f"{timing.memory:.0f}"] if with_memory else []))
    print_table(head, rows, title=f"{title} ({unit})", text_columns=7, width=120)


def main() -> None:
    """Measures, prints and writes."""
    options = parser(__doc__, device=True, passes=3)
    options.add_argument("--quick", action="store_true", help="the small tables only")
    arguments = options.parse_args()
    device = torch.device(arguments.device)
    where = machine(device)
    print(json.dumps(where))
    suites = (gpu_suites if device.type == "cuda" else cpu_suites)(arguments.quick)
    unit = "milliseconds" if device.type == "cuda" else "core-milliseconds"
    results: dict[str, tuple[list[Case], list[Timing]]] = {}
    for title, cases in suites.items():
        results[title] = cases, compare(cases, device, arguments.passes)
        print_case_table(title, *results[title], unit)
    tables = {
        title: [asdict(case) | asdict(timing) for case, timing in zip(*result, strict=True)]
        for title, result in results.items()
    }
    content = {"machine": where, "unit": unit, "passes": arguments.passes, "tables": tables}
    write_results(arguments.out, f"render-{device.type}", content)


if __name__ == "__main__":
    main()
