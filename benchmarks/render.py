"""Speed of the renderer's implementations on a CPU: ``python benchmarks/render.py``; ``gpu.py`` measures a GPU.

Measures all cases alternately in one process and prints their ratio to the first. Times are the best of several passes,
in core-milliseconds. Writes a dated JSON file to ``benchmarks/results``.

The scene is a box-shaped room seen from inside, which imitates the output of a feed-forward model: one flat Gaussian
per source pixel, slightly off the surface, slightly misaligned, with varied size and opacity.
"""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, replace

import torch
from common import MEGABYTE, machine, parser, used_seconds, write_results
from torch import Tensor
from torch.nn import functional as F

from vg2gt.geometry.cameras import invert_rigid
from vg2gt.geometry.rotations import matrix_to_quat
from vg2gt.geometry.spherical_harmonics import rgb_to_sh
from vg2gt.profiling import reset_peak_memory
from vg2gt.rendering import Renderer
from vg2gt.rendering.options import Mode
from vg2gt.types import Cameras, Gaussians

PARAMETERS = ("means", "quats", "scales", "opacities", "sh")
ROOM = (4.2, 2.6, 3.4)  # metres: x, height (y down), z
SOURCES = 8


def room_cameras(views: int, size: tuple[int, int]) -> Cameras:
    """Returns cameras ``[1, views]`` on a line that look at the room's far corner."""
    height, width = size
    step = torch.linspace(0, 1, views)[:, None]
    eye = torch.tensor([0.6, 1.3, 0.5]) + step * torch.tensor([0.5, -0.2, 0.9])
    target = torch.tensor([3.6, 1.5, 2.0]) + step * torch.tensor([0.0, 0.0, 0.8])
    forward = F.normalize(target - eye, dim=-1)
    right = F.normalize(torch.linalg.cross(torch.tensor([[0.0, 1.0, 0.0]]), forward), dim=-1)
    pose = torch.eye(4).repeat(views, 1, 1)
    pose[:, :3, :3] = torch.stack((right, torch.linalg.cross(forward, right), forward), 1)
    pose[:, :3, 3:] = -pose[:, :3, :3] @ eye[..., None]
    focal = 0.8 * width
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Cameras(pose[None], intrinsics.expand(1, views, 3, 3).clone(), size)


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
    mode: Mode = "solid"
    geometry: bool = True
    threads: int = 1

    @property
    def scene(self) -> tuple[int, tuple[int, int], int]:
        """What determines Gaussians and cameras."""
        return self.gaussians, self.size, self.views


@dataclass
class Timing:
    """Best times of a case in milliseconds, and peak GPU memory in MB."""

    forward: float = float("inf")
    backward: float = float("inf")
    memory: float = 0.0


def measure_once(case: Case, gaussians: Gaussians, cameras: Cameras) -> Timing:
    """Times one forward and one backward pass with random incoming gradients."""
    torch.set_num_threads(case.threads)
    device = cameras.intrinsics.device
    reset_peak_memory(device)
    before = torch.cuda.memory_allocated(device) if device.type == "cuda" else 0
    start = used_seconds(device)
    renderer = Renderer(case.mode, implementation=case.implementation, geometry=case.geometry)  # type: ignore[arg-type]
    out = renderer(gaussians, cameras)
    forward = used_seconds(device) - start
    outputs = [out.color, out.depth, out.normal, out.alpha] if case.geometry else [out.color]
    weights = [torch.randn_like(output) for output in outputs]
    start = used_seconds(device)
    torch.autograd.grad(outputs, [getattr(gaussians, name) for name in PARAMETERS], weights, allow_unused=True)
    backward = used_seconds(device) - start
    memory = (torch.cuda.max_memory_allocated(device) - before) / MEGABYTE if device.type == "cuda" else 0.0
    return Timing(1e3 * forward, 1e3 * backward, memory)


def compare(cases: list[Case], device: torch.device, passes: int) -> list[Timing]:
    """Measures the cases alternately; the first pass is a warm-up, and the dense reference gets a single other one."""
    scenes = {}
    for case in cases:
        gaussians = room_gaussians(case.gaussians, case.size).to(device)
        gaussians = gaussians.map(lambda t: t.requires_grad_() if t.is_floating_point() else t)
        scenes[case.scene] = gaussians, room_cameras(case.views, case.size).to(device)
    best = [Timing() for _ in cases]
    for number in range(passes + 1):
        for case, timing in zip(cases, best, strict=True):
            if case.implementation == "dense" and number > 1:
                continue
            once = measure_once(case, *scenes[case.scene])
            if number > 0:
                timing.forward, timing.backward = min(timing.forward, once.forward), min(timing.backward, once.backward)
                timing.memory = max(timing.memory, once.memory)
    return best


def suites() -> dict[str, list[Case]]:
    """Returns the cases by table."""
    base, cores = Case("cpu", 100_000), os.cpu_count() or 1
    kinds = [("solid", True), ("solid", False), ("rasterized", True), ("rasterized", False)]
    return {
        "implementations": [Case(name, 1_500, (40, 80)) for name in ("cpu", "dense")],
        "outputs": [replace(base, mode=mode, geometry=geometry) for mode, geometry in kinds],
        "Gaussians": [replace(base, gaussians=n) for n in (10_000, 30_000, 100_000, 300_000)],
        "views": [replace(base, gaussians=30_000, views=v) for v in (1, 2, 4, 8)],
        "threads": [replace(base, views=2, threads=t) for t in sorted({1, 2, cores // 2, cores} - {0})],
    }


def main() -> None:
    """Measures, prints and writes."""
    options = parser(__doc__)
    options.add_argument("--passes", type=int, default=3)
    arguments = options.parse_args()
    tables: dict[str, list[dict[str, object]]] = {}
    for title, cases in suites().items():
        timings = compare(cases, torch.device("cpu"), arguments.passes)
        for case, timing in zip(cases, timings, strict=True):
            ratio = (timing.forward + timing.backward) / (timings[0].forward + timings[0].backward)
            print(f"{title}: {case}, forward {timing.forward:.1f}, backward {timing.backward:.1f}, ratio {ratio:.2f}")
        tables[title] = [asdict(case) | asdict(timing) for case, timing in zip(cases, timings, strict=True)]
    content = {"machine": machine(), "unit": "core-milliseconds", "passes": arguments.passes, "tables": tables}
    write_results(arguments.out, "render-cpu", content)


if __name__ == "__main__":
    main()
