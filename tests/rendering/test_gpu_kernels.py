"""The Triton kernels compile to machine code for GPUs of three generations, within bounds of registers and spills."""

import importlib.util
import os

import pytest

if importlib.util.find_spec("triton") is None:
    pytest.skip("needs triton, which has wheels for Linux on x86-64 only", allow_module_level=True)
if os.environ.get("TRITON_INTERPRET") == "1":
    pytest.skip("the interpreter's kernels cannot be compiled", allow_module_level=True)

from tests.rendering.kernel_launches import compile_for, variants

NVIDIA = ("sm_80", "sm_90", "sm_100")
# The most registers a thread may take, over all targets. 1-warp programs of up to 64 registers fill all 32 places of a
# multiprocessor, of up to 72 registers 28 of them. The last kernel of the backward pass may keep four in memory, as the
# assembler prefers for sm_100 in three of its eight variants to fewer programs at once; no other may spill.
REGISTERS = {"project": 80, "emit": 40, "list": 40, "blend": 80, "backward": 80, "project_backward": 168}
SPILLS = {"project_backward": 16}  # bytes a thread
SHORT = (
    "project solid=True antialiased=True degree=2",
    "emit",
    "list",
    "blend newton=True solid=True geometry=True mean=False",
    "backward solid=True geometry=True mean=False absolute=False",
    "backward solid=False geometry=False mean=False absolute=True",
)


def hold(found: list) -> None:
    for row in found:
        print(row)
    assert not [row for row in found if not 16 <= row.registers <= REGISTERS[row.variant.split()[0]]]
    assert not [row for row in found if row.spills > SPILLS.get(row.variant.split()[0], 0)]
    assert not [row for row in found if row.shared > 1024]


def test_the_main_kernels_compile_for_a_gpu_that_is_not_there() -> None:
    launches = variants()
    hold([compile_for(launches[name], "sm_90") for name in SHORT])


@pytest.mark.slow
@pytest.mark.parametrize("target", NVIDIA)
def test_all_variants_compile_for_three_generations(target: str) -> None:
    launches = variants()
    assert {name.split()[0] for name in launches} == set(REGISTERS)
    hold([compile_for(launch, target) for launch in launches.values()])


@pytest.mark.slow
def test_all_variants_compile_for_amd() -> None:
    rows = [compile_for(launch, "gfx942") for launch in variants().values()]
    assert all(row.spills == 0 and 0 < row.registers <= 256 for row in rows), rows
