"""``vg2gt doctor``: reports packages, devices, the selected renderer and the correctness of its kernels."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import vg2gt
from vg2gt.cli.arguments import flag_parser
from vg2gt.cli.errors import errors_in_one_line

if TYPE_CHECKING:
    import torch

NEEDED = ("torch", "lightning", "numba", "numpy")
_OPTIONAL = ("triton", "pycolmap", "av", "lzfse", "huggingface_hub", "onnx", "onnxscript", "tensorboard", "wandb")


def main(argv: Sequence[str] | None = None) -> None:
    """Prints each finding on one line, as soon as it is known."""
    flag_parser("doctor").parse_args(argv)
    with errors_in_one_line():
        for what, found in _findings():
            print(f"{what:<12} {found}", flush=True)


def _findings() -> Iterator[tuple[str, str]]:
    """Yields what is checked and the result."""
    yield "vg2gt", f"{vg2gt.__version__} ({vg2gt.source()}), Python {platform.python_version()}, {platform.platform()}"
    yield "packages", ", ".join(f"{name} {_version(name)}" for name in NEEDED)
    yield "optional", ", ".join(f"{name} {_version(name)}" for name in _OPTIONAL)
    yield from _folders()
    import torch

    yield "cpu", f"{os.cpu_count()} cores, torch uses {torch.get_num_threads()} threads"
    yield from _renderer(torch.device("cpu"))
    if not torch.cuda.is_available():
        yield "gpu", f"none that torch {torch.__version__} can use"
    for index in range(torch.cuda.device_count() if torch.cuda.is_available() else 0):
        device = torch.device("cuda", index)
        found = torch.cuda.get_device_properties(device)
        yield f"gpu {index}", f"{found.name}, {found.total_memory / 2**30:.0f} GiB"
        yield from _renderer(device)


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "missing"


def _folders() -> Iterator[tuple[str, str]]:
    """Cache folders of data and compiled kernels."""
    from vg2gt.kernels.compiled import cache_folder

    data = Path(os.environ.get("VG2GT_CACHE", "~/.cache/vg2gt")).expanduser()
    yield "data", f"{data} (set VG2GT_CACHE to use another folder)"
    yield "kernels", str(cache_folder() or "no writable cache folder: every process recompiles")


def _renderer(device: torch.device) -> Iterator[tuple[str, str]]:
    """The renderer that ``auto`` selects on a device, and the newly measured error of the kernels."""
    from vg2gt.rendering.renderer import automatic
    from vg2gt.rendering.selfcheck import KernelsRefusedError, compare, identity

    where = "" if device.type == "cpu" else f" on {identity(device)}"
    try:
        chosen = f"auto is '{automatic(device)}'{where}"
    except KernelsRefusedError as error:
        chosen = str(error)
    yield "renderer", chosen
    if device.type != "cpu" and _version("triton") != "missing":
        try:
            yield "kernels", f"'triton': {compare(device)}"
        except Exception as error:  # any failure is part of the report
            yield "kernels", f"'triton' does not run: {type(error).__name__}: {' '.join(str(error).split())[:300]}"
