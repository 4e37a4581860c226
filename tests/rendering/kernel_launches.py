"""Launches of the renderer's Triton kernels, recorded and compiled to machine code without a GPU.

No driver is needed, as Triton's wheel includes the assembler.
"""

from __future__ import annotations

import os
import re
import subprocess
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple
from unittest import mock

import torch
import triton  # pyright: ignore[reportMissingImports]
from torch import Tensor
from triton import knobs  # pyright: ignore[reportMissingImports]
from triton.backends.compiler import GPUTarget  # pyright: ignore[reportMissingImports]

from tests.rendering.scenes import cameras_around, floats_to, soup, with_gradients
from vg2gt.rendering import Renderer
from vg2gt.rendering.gpu import kernels

TARGETS = {
    "sm_80": GPUTarget("cuda", 80, 32),
    "sm_90": GPUTarget("cuda", 90, 32),
    "sm_100": GPUTarget("cuda", 100, 32),
    "gfx942": GPUTarget("hip", "gfx942", 64),
}
TYPES = {torch.float32: "*fp32", torch.int32: "*i32", torch.int64: "*i64", torch.int16: "*i16", torch.bool: "*i1"}


@dataclass(frozen=True)
class Launch:
    """A recorded kernel launch.

    Attributes:
        kernel: name of the kernel.
        arguments: arguments by name, including compile-time ones; dtypes in place of tensors.
        options: launch options such as ``num_warps``.
    """

    kernel: str
    arguments: dict[str, Any]
    options: dict[str, Any]

    @property
    def constants(self) -> dict[str, Any]:
        """Compile-time arguments."""
        names = {parameter.name for parameter in getattr(kernels, self.kernel).params if parameter.is_constexpr}
        return {name: value for name, value in self.arguments.items() if name in names}

    @property
    def signature(self) -> dict[str, str]:
        """Types of the arguments in Triton's notation."""

        def kind(value: Any) -> str:
            if isinstance(value, torch.dtype):
                return TYPES[value]
            return "i64" if isinstance(value, int) and abs(value) >= 1 << 31 else "i32"

        constants = self.constants
        return {n: "constexpr" if n in constants else kind(value) for n, value in self.arguments.items()}

    @property
    def variant(self) -> str:
        """Name of the kernel with the compile-time options that change its code."""
        chosen = [f"{n}={value}" for n, value in self.constants.items() if isinstance(value, bool) or n == "degree"]
        return " ".join([self.kernel.removesuffix("_kernel"), *chosen])


class Compiled(NamedTuple):
    """Registers of a kernel per thread, bytes of shared memory per program, and of spilled registers per thread."""

    variant: str
    registers: int
    shared: int
    spills: int


@contextmanager
def recorded(stubs: dict[str, Callable[..., Any]] | None = None) -> Iterator[list[Launch]]:
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

        def __getitem__(self, _: object) -> Callable[..., None]:
            def launch(*arguments: Any, **options: Any) -> None:
                named = dict(zip(self.names, arguments, strict=False))
                named |= {name: options.pop(name) for name in self.names if name in options}
                # keep only the dtypes of tensors, so that their memory is freed as usual
                kept = {name: value.dtype if isinstance(value, Tensor) else value for name, value in named.items()}
                launches.append(Launch(self.name, kept, options))
                if self.name in stubs:
                    stubs[self.name](**named)

            return launch

    with ExitStack() as stack:
        for name in [name for name in vars(kernels) if name.endswith("_kernel")]:
            stack.enter_context(mock.patch.object(kernels, name, Recorder(name)))
        stack.enter_context(mock.patch.dict(os.environ, TRITON_INTERPRET="1"))
        yield launches


def variants() -> dict[str, Launch]:
    """Launches of all kernel variants that rendering and its backward pass use, by name and options."""
    found: dict[str, Launch] = {}
    kinds = [("solid", "median", True), ("rasterized", "median", True), ("rasterized", "expected", True)]
    kinds += [(mode, "median", False) for mode in ("solid", "rasterized")]
    cases = [(*case, False, False) for case in product(kinds, (0, 1, 2, 3))]
    cases += [((mode, "median", True), degree, True, False) for mode in ("solid", "rasterized") for degree in (0, 2)]
    cases += [(kind, 0, False, True) for kind in kinds]
    for (mode, depth, geometry), degree, antialiased, absgrad in cases:
        gaussians = with_gradients(floats_to(soup(40, degree=degree), torch.float32))
        cameras = floats_to(cameras_around((16, 24)), torch.float32)
        cameras = replace(cameras, world_to_camera=cameras.world_to_camera.requires_grad_(degree == 0))
        options: Any = {"mode": mode, "depth": depth, "geometry": geometry, "antialiased": antialiased}
        renderer = Renderer(implementation="triton", **options, absgrad=absgrad)
        with recorded() as launches:
            out = renderer(gaussians, cameras)
            outputs = [out.color, out.depth, out.normal] if geometry else [out.color]
            torch.autograd.backward(outputs, [torch.ones_like(image) for image in outputs])
        found |= {launch.variant: launch for launch in launches}
    return found


def compile_for(launch: Launch, target: str) -> Compiled:
    """Compiles a recorded launch to machine code and reads its resources."""
    signature = launch.signature
    aligned = {(i,): [["tt.divisibility", 16]] for i, kind in enumerate(signature.values()) if kind.startswith("*")}
    source = triton.compiler.ASTSource(getattr(kernels, launch.kernel), signature, launch.constants, aligned)
    options = {"num_warps": 4, **launch.options}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Triton warns of defaults that will change
        made = triton.compile(source, target=TARGETS[target], options=options)
    if TARGETS[target].backend == "hip":
        said = made.asm["amdgcn"]
        names = (r"\.vgpr_count:\s+", r"\.vgpr_spill_count:\s+", r"\.sgpr_spill_count:\s+")
    else:
        with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
            file.write(made.asm["cubin"])
            file.flush()
            command = [knobs.nvidia.cuobjdump.path, "-res-usage", file.name]
            said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        names = ("REG:", "STACK:", "LOCAL:")  # Triton's kernels use the stack only for spills
    registers, *spills = (int(re.findall(rf"{name}(\d+)", said)[0]) for name in names)
    spilled = sum(spills) * (4 if TARGETS[target].backend == "hip" else 1)  # AMD counts registers
    return Compiled(launch.variant, registers, made.metadata.shared, spilled)
