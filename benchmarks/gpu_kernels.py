"""Compiles every Triton kernel of the renderer, without a GPU: ``python benchmarks/gpu_kernels.py``.

Renders small scenes with the kernels replaced by recorders, and compiles each recorded launch, with its types and
compile-time options, to machine code for several targets. Prints registers, shared memory and spills. Needs no GPU and
no driver, as Triton's wheel includes the assembler. Writes a dated JSON file.
"""

from __future__ import annotations

import os
import re
import subprocess
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any
from unittest import mock

import torch
import triton  # pyright: ignore[reportMissingImports]
from common import machine, parser, write_results
from render import room_cameras, room_gaussians
from torch import Tensor
from triton import knobs  # pyright: ignore[reportMissingImports]
from triton.backends.compiler import GPUTarget  # pyright: ignore[reportMissingImports]

from vg2gt.evaluation.tables import print_table
from vg2gt.kernels.render_gpu import kernels
from vg2gt.rendering import Renderer

TARGETS = {
    "sm_80": GPUTarget("cuda", 80, 32),
    "sm_90": GPUTarget("cuda", 90, 32),
    "sm_100": GPUTarget("cuda", 100, 32),
    "gfx942": GPUTarget("hip", "gfx942", 64),
}
NVIDIA = ("sm_80", "sm_90", "sm_100")
TYPES = {
    torch.float32: "*fp32",
    torch.int32: "*i32",
    torch.int64: "*i64",
    torch.int16: "*i16",
    torch.bool: "*i1",
}
Stub = Callable[..., Any]


@dataclass(frozen=True)
class Launch:
    """A recorded kernel launch.

    Attributes:
        kernel: name of the kernel.
        grid: number of programs per axis.
        arguments: arguments by name, including compile-time ones; dtypes in place of tensors.
        options: launch options such as ``num_warps``.
    """

    kernel: str
    grid: tuple[int, ...]
    arguments: dict[str, Any]
    options: dict[str, Any]

    @property
    def signature(self) -> dict[str, str]:
        """Types of the arguments in Triton's notation."""
        return {name: _type(name, value, self.constants) for name, value in self.arguments.items()}

    @property
    def constants(self) -> dict[str, Any]:
        """Compile-time arguments."""
        names = {parameter.name for parameter in getattr(kernels, self.kernel).params if parameter.is_constexpr}
        return {name: value for name, value in self.arguments.items() if name in names}

    @property
    def variant(self) -> str:
        """Name of the kernel with the compile-time options that change its code."""
        chosen = [
            f"{name}={value}" for name, value in self.constants.items() if isinstance(value, bool) or name == "degree"
        ]
        return " ".join([self.kernel.removesuffix("_kernel"), *chosen])


@dataclass(frozen=True)
class Compiled:
    """Resources of a compiled kernel.

    Attributes:
        variant: kernel and options.
        target: target such as ``sm_90``.
        warps: warps per program.
        registers: registers per thread.
        shared: bytes of shared memory per program.
        spills: bytes of spilled registers per thread.
    """

    variant: str
    target: str
    warps: int
    registers: int
    shared: int
    spills: int


def _type(name: str, value: Any, constants: dict[str, Any]) -> str:
    if name in constants:
        return "constexpr"
    if isinstance(value, torch.dtype):
        return TYPES[value]
    return "i64" if isinstance(value, int) and abs(value) >= 1 << 31 else "i32"


@contextmanager
def recorded(stubs: dict[str, Stub] | None = None) -> Iterator[list[Launch]]:
    """Records kernel launches in the block instead of running them; the renderer then accepts CPU tensors.

    Args:
        stubs: functions to call in place of kernels, by kernel name, with the launch's arguments by name. By default,
            ``project_kernel`` puts every Gaussian in one tile.
    """
    stubs = {"project_kernel": lambda counts, **_: counts.fill_(1), **(stubs or {})}
    launches: list[Launch] = []

    class Recorder:
        def __init__(self, name: str) -> None:
            self.name, self.names = name, getattr(kernels, name).arg_names

        def __getitem__(self, grid: Sequence[int]) -> Callable[..., None]:
            def launch(*arguments: Any, **options: Any) -> None:
                named = dict(zip(self.names, arguments, strict=False))
                named |= {name: options.pop(name) for name in self.names if name in options}
                # keep only the dtypes of tensors, so that their memory is freed as usual
                kept = {name: value.dtype if isinstance(value, Tensor) else value for name, value in named.items()}
                launches.append(Launch(self.name, tuple(grid), kept, options))
                if self.name in stubs:
                    stubs[self.name](**named)

            return launch

    with ExitStack() as stack:
        for name in [name for name in vars(kernels) if name.endswith("_kernel")]:
            stack.enter_context(mock.patch.object(kernels, name, Recorder(name)))
        stack.enter_context(mock.patch.dict(os.environ, TRITON_INTERPRET="1"))
        yield launches


def variants() -> dict[str, Launch]:
    """Returns launches of all kernel variants that rendering and its backward pass use, by name and options."""
    found: dict[str, Launch] = {}
    kinds = [("solid", "median", True), ("rasterized", "median", True), ("rasterized", "expected", True)]
    kinds += [(mode, "median", False) for mode in ("solid", "rasterized")]
    for (mode, depth, geometry), degree in product(kinds, (0, 1, 2, 3)):
        gaussians = room_gaussians(40, (16, 24))
        sh = torch.zeros(len(gaussians), (degree + 1) ** 2, 3)
        gaussians = replace(gaussians, sh=sh).map(lambda t: t.requires_grad_() if t.is_floating_point() else t)
        cameras = room_cameras(2, (16, 24))
        cameras = replace(cameras, world_to_camera=cameras.world_to_camera.requires_grad_(degree == 0))
        renderer = Renderer(mode=mode, depth=depth, geometry=geometry, implementation="triton")  # type: ignore[arg-type]
        with recorded() as launches:
            out = renderer(gaussians, cameras)
            outputs = [out.color, out.depth, out.normal] if geometry else [out.color]
            torch.autograd.backward(outputs, [torch.ones_like(image) for image in outputs])
        found |= {launch.variant: launch for launch in launches}
    return found


def compile_for(launch: Launch, target: str) -> Compiled:
    """Compiles a recorded launch to machine code and reads its resources."""
    signature = launch.signature
    pointers = [index for index, kind in enumerate(signature.values()) if kind.startswith("*")]
    aligned = {(index,): [["tt.divisibility", 16]] for index in pointers}
    source = triton.compiler.ASTSource(getattr(kernels, launch.kernel), signature, launch.constants, aligned)
    options = {"num_warps": 4, **launch.options}
    warps = options["num_warps"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Triton warns of defaults that will change
        made = triton.compile(source, target=TARGETS[target], options=options)
    if TARGETS[target].backend == "hip":
        return _amd(launch, target, warps, made)
    registers, spills = _resources(made.asm["cubin"])
    return Compiled(launch.variant, target, warps, registers, made.metadata.shared, spills)


def _resources(cubin: bytes) -> tuple[int, int]:
    """Registers, and bytes of stack (used only for spills by Triton's kernels), of an Nvidia program."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "kernel.cubin"
        path.write_bytes(cubin)
        command = [knobs.nvidia.cuobjdump.path, "-res-usage", str(path)]
        said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    (registers,), (stack,), (local,) = (re.findall(rf"{word}:(\d+)", said) for word in ("REG", "STACK", "LOCAL"))
    return int(registers), int(stack) + int(local)


def _amd(launch: Launch, target: str, warps: int, made: Any) -> Compiled:
    def value(name: str) -> int:
        return int(re.findall(rf"\.{name}:\s+(\d+)", made.asm["amdgcn"])[0])

    spills = 4 * value("vgpr_spill_count") + 4 * value("sgpr_spill_count")
    return Compiled(launch.variant, target, warps, value("vgpr_count"), made.metadata.shared, spills)


def main() -> None:
    """Compiles, prints and writes."""
    options = parser(__doc__)
    options.add_argument("--targets", nargs="+", choices=TARGETS, default=list(TARGETS))
    arguments = options.parse_args()
    wanted = [(launch, target) for launch in variants().values() for target in arguments.targets]
    found: list[Compiled] = []
    for number, (launch, target) in enumerate(wanted, start=1):
        print(f"{number}/{len(wanted)} {launch.variant} for {target}", flush=True)  # some take a minute
        found.append(compile_for(launch, target))
    head = ["kernel", "target", "warps", "registers", "shared", "spilled bytes"]
    print_table(head, [[str(value) for value in asdict(row).values()] for row in found], text_columns=2, width=120)
    rows = [asdict(row) for row in found]
    write_results(arguments.out, "gpu-kernels", {"machine": machine(), "triton": triton.__version__, "kernels": rows})


if __name__ == "__main__":
    main()
