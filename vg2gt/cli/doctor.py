"""``vg2gt doctor``: what this machine has, which renderer it gets, whether its kernels are right and how fast."""

from __future__ import annotations

import argparse
import importlib.metadata
import os
import platform
import re
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import vg2gt
from vg2gt.cli.arguments import flag_parser
from vg2gt.cli.commands import COMMANDS
from vg2gt.cli.errors import errors_in_one_line

if TYPE_CHECKING:
    import torch

NEEDED = ("torch", "lightning", "numba", "numpy")
BENCHMARK = {"cpu": (20_000, 1), "cuda": (100_000, 8)}  # Gaussians, views of 224 x 448
SECONDS = 10.0


def parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    arguments = flag_parser("doctor", COMMANDS["doctor"])
    arguments.add_argument("--no-speed", action="store_true", help="do not time the renderer (about 10 s a device)")
    return arguments


def main(argv: Sequence[str] | None = None) -> None:
    """Prints one line a finding as it is found."""
    options = parser().parse_args(argv)
    with errors_in_one_line():
        for what, found in findings(timed=not options.no_speed):
            print(f"{what:<12} {found}", flush=True)


def findings(timed: bool) -> Iterator[tuple[str, str]]:
    """What was looked at and what was found."""
    yield "vg2gt", f"{vg2gt.__version__} ({vg2gt.source()}), Python {platform.python_version()}, {platform.platform()}"
    yield "packages", ", ".join(f"{name} {_version(name)}" for name in NEEDED)
    yield from _optional()
    yield from _folders()
    import torch

    yield "cpu", f"{os.cpu_count()} cores, torch uses {torch.get_num_threads()} threads"
    yield from _renderer(torch.device("cpu"), timed)
    if not torch.cuda.is_available():
        yield "gpu", f"none that torch {torch.__version__} can use"
    for index in range(torch.cuda.device_count() if torch.cuda.is_available() else 0):
        device = torch.device("cuda", index)
        found = torch.cuda.get_device_properties(device)
        yield f"gpu {index}", f"{found.name}, {found.total_memory / 2**30:.0f} GiB"
        yield from _renderer(device, timed)


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "missing"


def _optional() -> Iterator[tuple[str, str]]:
    """The extras' packages, by extra; those for tests apart."""
    extras: dict[str, list[str]] = {}
    for line in importlib.metadata.requires("vg2gt") or [] if _version("vg2gt") != "missing" else []:
        name = re.match(r"[\w.-]+", line)
        extra = re.search(r"extra == ['\"](\w+)['\"]", line)
        if name and extra and extra[1] != "test":
            extras.setdefault(extra[1], []).append(name[0])
    for extra, names in {**extras, "gpu": ["triton", "gsplat"]}.items():
        yield f"[{extra}]", ", ".join(f"{name} {_version(name)}" for name in names)


def _folders() -> Iterator[tuple[str, str]]:
    """Where data and what was computed are kept, and how much."""
    from vg2gt.kernels.compiled import cache_folder

    data = Path(os.environ.get("VG2GT_CACHE", "~/.cache/vg2gt")).expanduser()
    yield "data", f"{data} ({_size(data)}; the variable VG2GT_CACHE names another folder)"
    kernels = cache_folder()
    yield (
        "kernels",
        "cannot be kept: every start compiles again" if kernels is None else f"{kernels} ({_size(kernels)})",
    )
    triton = Path(os.environ.get("TRITON_CACHE_DIR", "~/.triton/cache")).expanduser()
    yield "triton", f"{triton} ({_size(triton)})"


def _size(folder: Path) -> str:
    if not folder.is_dir():
        return "not there yet"
    return f"{sum(path.stat().st_size for path in folder.rglob('*') if path.is_file()) / 1e6:.0f} MB"


def _renderer(device: torch.device, timed: bool) -> Iterator[tuple[str, str]]:
    """Which renderer ``auto`` is there, how far the kernels are off (measured again), and how long it takes."""
    from vg2gt.rendering.renderer import automatic
    from vg2gt.rendering.selfcheck import KernelsRefusedError, compare, identity

    where = "" if device.type == "cpu" else f" on {identity(device)}"
    try:
        chosen = f"auto is '{automatic(device)}'{where}"
    except KernelsRefusedError as error:
        chosen, timed = str(error), False
    yield "renderer", chosen
    if device.type != "cpu" and _version("triton") != "missing":
        try:
            yield "kernels", f"'triton': {compare(device)}"
        except Exception as error:  # the report is what this command is for
            yield "kernels", f"'triton' does not run: {type(error).__name__}: {' '.join(str(error).split())[:300]}"
    if timed:
        count, views = BENCHMARK[device.type]
        milliseconds = _milliseconds(device, count, views)
        yield "speed", f"{milliseconds:.1f} ms for {count:,} Gaussians, {views} views of 224x448, forward and backward"


def _milliseconds(device: torch.device, count: int, views: int) -> float:
    """Best time of some passes by the clock, within ten seconds."""
    import torch

    from vg2gt.profiling import now
    from vg2gt.rendering import render
    from vg2gt.types import Cameras, Gaussians

    generator = torch.Generator().manual_seed(0)
    depth = 2 + 2 * torch.rand(count, generator=generator)
    sides = torch.rand(count, 2, generator=generator) - 0.5
    means = torch.cat((sides * torch.tensor([2.0, 1.0]) * depth[:, None], depth[:, None]), -1)
    quats = torch.randn(count, 4, generator=generator)
    scales = 0.01 * torch.exp(0.3 * torch.randn(count, 3, generator=generator))
    opacities, sh = torch.rand(count, generator=generator), torch.randn(count, 1, 3, generator=generator)
    gaussians = Gaussians(means, quats, scales, opacities, sh, torch.zeros(count, dtype=torch.int64)).to(device)
    leaves = [gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh]
    for tensor in leaves:
        tensor.requires_grad_()
    intrinsics = torch.tensor([[220.0, 0, 224], [0, 220, 112], [0, 0, 1]], device=device).expand(1, views, 3, 3)
    poses = torch.eye(4, device=device).repeat(1, views, 1, 1)
    poses[0, :, 0, 3] = torch.linspace(-0.2, 0.2, views, device=device)
    best, begin = float("inf"), time.perf_counter()
    while time.perf_counter() - begin < SECONDS:
        start = now(device)
        out = render(gaussians, Cameras(poses, intrinsics, (224, 448)))
        torch.autograd.grad(out.color.sum() + out.depth.sum(), leaves)
        best = min(best, now(device) - start)
    return 1e3 * best
