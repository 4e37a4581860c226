"""Speed, and on a GPU memory, of the renderer's implementations: ``python benchmarks/render.py [--device cuda]``.

Measures all implementations alternately in one process and compares them by ratio. Times are the best of several
passes: core-milliseconds on a CPU (with one thread unless the table says otherwise), milliseconds on a GPU. Prints
tables and writes a dated JSON file to ``benchmarks/results``.

The scene is a box-shaped room seen from inside, which imitates the output of a feed-forward model: one flat Gaussian
per source pixel, slightly off the surface, slightly misaligned, with varied size and opacity.
"""

from __future__ import annotations

import json
import os
import time
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from common import MEGABYTE, machine, parser, used_seconds, write_results
from torch import Tensor
from torch.nn import functional as F

from vg2gt.evaluation.tables import print_table
from vg2gt.geometry.cameras import invert_rigid
from vg2gt.geometry.rotations import matrix_to_quat
from vg2gt.geometry.spherical_harmonics import rgb_to_sh
from vg2gt.rendering import render
from vg2gt.types import Cameras, Gaussians

PARAMETERS = ("means", "quats", "scales", "opacities", "sh")
ROOM = (4.2, 2.6, 3.4)  # metres: x, height (y down), z
SOURCES = 8


def room_cameras(views: int, size: tuple[int, int]) -> Cameras:
    """Returns cameras ``[1, views]`` on a line that look at the room's far corner."""
    height, width = size
    poses = []
    for index in range(views):
        step = index / max(views - 1, 1)
        eye = torch.tensor([0.6 + 0.5 * step, 1.3 - 0.2 * step, 0.5 + 0.9 * step])
        forward = F.normalize(torch.tensor([3.6, 1.5, 2.0 + 0.8 * step]) - eye, dim=0)
        right = F.normalize(torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]), forward), dim=0)
        rotation = torch.stack((right, torch.linalg.cross(forward, right), forward))
        pose = torch.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eye
        poses.append(pose)
    focal = 0.8 * width
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Cameras(torch.stack(poses)[None], intrinsics.expand(1, views, 3, 3).clone(), size)


def room_gaussians(count: int, size: tuple[int, int], sigma: float = 1.0, seed: int = 0) -> Gaussians:
    """Returns Gaussians at random pixels of 8 source views.

    Args:
        count: number of Gaussians.
        size: size of the source views ``(height, width)``.
        sigma: mean scale in source pixels.
        seed: random seed.
    """
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    cameras = room_cameras(SOURCES, size)
    height, width = size
    per_view = -(-count // SOURCES)
    pixels = torch.rand(1, SOURCES, per_view, 2, generator=generator) * torch.tensor([width, height])
    focal, center = cameras.intrinsics[0, 0, 0, 0], cameras.intrinsics[0, 0, [0, 1], [2, 2]]
    rays = F.pad((pixels - center) / focal, (0, 1), value=1.0)
    # where the rays hit the walls, and inward normals there
    to_world = invert_rigid(cameras.world_to_camera)[:, :, None]
    origin, direction = to_world[..., :3, 3], (to_world[..., :3, :3] @ rays[..., None])[..., 0]
    depth, axis = (torch.where(direction > 0, torch.tensor(ROOM) - origin, -origin) / direction).min(-1)
    hits = depth, origin + depth[..., None] * direction, -F.one_hot(axis, 3) * direction.sign()
    depth, point, facing = (tensor.flatten(0, 2)[:count] for tensor in hits)
    # flat Gaussians there, slightly misaligned
    third = F.normalize(facing + 0.15 * normal(count, 3), dim=-1)
    first = F.normalize(torch.linalg.cross(third, normal(count, 3)), dim=-1)
    axes = torch.stack((first, torch.linalg.cross(third, first), third), -1)
    scales = (sigma * depth / focal)[:, None] * torch.exp(0.25 * normal(count, 3)) * torch.tensor([1.0, 1.0, 0.25])
    colors = 0.5 + 0.4 * torch.sin(point @ torch.tensor([[3.0, 1, 2], [1, 4, 1], [2, 2, 5]])) + 0.03 * normal(count, 3)
    return Gaussians(
        means=point + facing * 0.003 * normal(count, 1),
        quats=matrix_to_quat(axes),
        scales=scales,
        opacities=torch.sigmoid(0.8 + 1.2 * normal(count)),
        sh=rgb_to_sh(colors)[:, None],
        batch=torch.zeros(count, dtype=torch.int64),
    )


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
            replace(base, gaussians=1_500, size=(40, 80), sigma=1.2, implementation=name) for name in ("cpu", "dense")
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
    suites["Gaussians"] = [replace(base, gaussians=n) for n in (10_000, 30_000, 100_000, 300_000)]
    suites["views"] = [replace(base, gaussians=30_000, views=v) for v in (1, 2, 4, 8)]
    suites["threads"] = [replace(base, views=2, threads=t) for t in sorted({1, 2, cores // 2, cores} - {0})]
    return suites


def gpu_suites(quick: bool) -> dict[str, list[Case]]:
    """Returns the cases for a GPU, by table; includes gsplat if installed."""
    try:
        import gsplat  # noqa: F401  # pyright: ignore[reportMissingImports]

        names = ("triton", "gsplat")
    except ImportError:
        names = ("triton",)
    sizes = ((224, 448),) if quick else ((224, 448), (518, 518))
    counts, views = ((100_000,), (1, 8)) if quick else ((100_000, 1_000_000), (1, 8, 18))
    base = Case("triton", 100_000)
    return {
        f"{height} x {width}": [
            replace(base, implementation=name, gaussians=count, size=(height, width), views=number)
            for count in counts
            for number in views
            for name in names
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
    options = parser(__doc__, device=True)
    options.add_argument("--passes", type=int, default=3)
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
