"""OpenSplat as a peer: its CPU rasteriser (``render.py --opensplat CHECKOUT``), its training (``photos.py``).

Its source stays in its own checkout (AGPL) and what is compiled of it in torch's folder of extensions; here is only how
it is called. It renders colour alone, and no gradient reaches what hides a Gaussian but the Gaussian itself. As
published, its program reads depths of Gaussians on a CPU through a strided view and blends them in a wrong order, and
leaves the principal point out: both must be mended in ``project_gaussians_forward_tensor_cpu`` before a comparison.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor
from torch.utils.cpp_extension import load_inline

from vg2gt.geometry.spherical_harmonics import DC
from vg2gt.types import Cameras, Gaussians

STEPS = 100  # of the first try, which tells how long a step takes
NEAR_ENOUGH = 0.1  # of a budget
TRIES = 3
BACKGROUND = (0.6130, 0.0101, 0.3984)  # its own, where nothing is opaque
SOURCE = Path("rasterizer/gsplat-cpu/gsplat_cpu.cpp")
NEAR, FAR = 0.01, 100.0
BINDINGS = r"""
#include <torch/extension.h>
#include "rasterizer/gsplat-cpu/gsplat_cpu.cpp"
using torch::Tensor;

std::vector<Tensor> project(Tensor means, Tensor scales, Tensor quats, Tensor view, Tensor projection,
                            float fx, float fy, float cx, float cy, int height, int width) {
  auto [xys, radii, conics, cov2d, depths] = project_gaussians_forward_tensor_cpu(
      means.size(0), means, scales, 1.f, quats, view, projection, fx, fy, cx, cy, height, width, 0.01f);
  return {xys, conics, cov2d, depths};
}

std::tuple<Tensor, Tensor, int64_t> forward(int height, int width, std::vector<Tensor> in) {
  auto [image, transmittance, hits] = rasterize_forward_tensor_cpu(
      width, height, in[0], in[1], in[2], in[3], in[4], in[5], in[6]);
  return {image, transmittance, reinterpret_cast<int64_t>(hits)};
}

std::tuple<Tensor, Tensor, Tensor, Tensor> backward(int height, int width, std::vector<Tensor> in,
                                                    Tensor transmittance, int64_t hits, Tensor gradient) {
  auto *lists = reinterpret_cast<std::vector<int32_t> *>(hits);
  auto none = torch::zeros({height, width});
  auto result = rasterize_backward_tensor_cpu(
      height, width, in[0], in[1], in[2], in[3], in[4], in[5], in[6], transmittance, lists, gradient, none);
  delete[] lists;
  return result;
}
"""


@cache
def extension(checkout: Path) -> ModuleType:
    """Compiles the rasteriser, once a machine.

    Raises:
        FileNotFoundError: if the folder is no checkout of OpenSplat.
    """
    if not (checkout / SOURCE).is_file():
        raise FileNotFoundError(f"{checkout} has no {SOURCE}: give the folder of a checkout of OpenSplat")
    module = load_inline(
        "opensplat_cpu",
        BINDINGS,
        functions=["project", "forward", "backward"],
        extra_cflags=["-O3"],  # its own release build
        extra_include_paths=[str(checkout.resolve())],
    )
    assert isinstance(module, ModuleType)
    return module


class _Rasterize(torch.autograd.Function):
    """Its rasteriser between the projection and the image."""

    @staticmethod
    def forward(ctx: Any, module: ModuleType, size: tuple[int, int], *inputs: Tensor) -> Tensor:
        """Blends; ``inputs`` are centres, conics, colours, opacities, background, covariances and depths."""
        kept = [tensor.contiguous() for tensor in inputs]
        image, transmittance, hits = module.forward(*size, kept)
        ctx.module, ctx.size, ctx.hits = module, size, hits
        ctx.save_for_backward(*kept, transmittance)
        return image

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of centres, conics, colours and opacities; may be called once."""
        *inputs, transmittance = ctx.saved_tensors
        found = ctx.module.backward(*ctx.size, inputs, transmittance, ctx.hits, gradients[0].contiguous())
        return None, None, *found, None, None, None


def rasterize(checkout: Path, gaussians: Gaussians, cameras: Cameras) -> Tensor:
    """The views' colours ``[1, V, 3, H, W]`` on black, of Gaussians of one constant colour each."""
    module, (height, width) = extension(checkout), cameras.size
    colors = gaussians.sh[:, 0] * DC + 0.5
    images = []
    for view, intrinsics in zip(cameras.world_to_camera[0], cameras.intrinsics[0], strict=True):
        fx, fy, cx, cy = (float(intrinsics[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
        projection = torch.zeros(4, 4)
        projection[0, 0], projection[0, 2] = 2 * fx / width, (2 * cx + 1) / width - 1
        projection[1, 1], projection[1, 2] = 2 * fy / height, (2 * cy + 1) / height - 1
        projection[2, 2], projection[2, 3], projection[3, 2] = FAR / (FAR - NEAR), -FAR * NEAR / (FAR - NEAR), 1
        xys, conics, cov2d, depths = module.project(
            *(gaussians.means, gaussians.scales, gaussians.quats, view, projection @ view, fx, fy, cx, cy),
            *(height, width),
        )
        inputs = (xys, conics, colors, gaussians.opacities[:, None], torch.zeros(3), cov2d.detach(), depths.detach())
        images.append(_Rasterize.apply(module, cameras.size, *inputs))
    return torch.stack(images).permute(0, 3, 1, 2)[None]


@dataclass(frozen=True)
class Training:
    """A scene that OpenSplat trained.

    Attributes:
        scene: its PLY file, in the frame of the given cameras.
        steps: how many were made.
        core_seconds: processor time from the first step on: libraries and images were loaded before.
        peak_memory: resident bytes at most.
    """

    scene: Path
    steps: int
    core_seconds: float
    peak_memory: int


def train(
    binary: Path, photos: Path, scene: Path, budget: float, extra: Sequence[str] = (), pace: float | None = None
) -> Training:
    """Trains on one thread for about so many core-seconds, which OpenSplat can only be told as a number of steps.

    A training that takes 10 % less or more than its budget is repeated with another number of steps.

    Args:
        binary: the program.
        photos: COLMAP scene.
        scene: PLY file to write; its cameras are written to the same folder.
        budget: core-seconds.
        extra: options over those chosen here.
        pace: core-seconds that a step is expected to take; None: this is tried first.

    Raises:
        RuntimeError: if the program fails, with the end of what it said.
    """
    if pace is None:
        tried = _train(binary, photos, scene, STEPS, extra)
        pace = tried.core_seconds / tried.steps
    steps = max(1, round(budget / pace))
    for _ in range(TRIES):
        run = _train(binary, photos, scene, steps, extra)
        ratio = budget / run.core_seconds
        if abs(1 - 1 / ratio) < NEAR_ENOUGH:
            break
        steps = max(1, round(steps * ratio))
    return run


def schedule(steps: int) -> list[str]:
    """OpenSplat's options for a training of so many steps, few against the 30,000 that its own are made for."""
    return [
        f"--num-iters={steps}",
        "--num-downscales=0",
        f"--sh-degree-interval={min(1000, max(1, steps // 4))}",
        f"--warmup-length={min(500, steps // 5)}",
    ]


def _train(binary: Path, photos: Path, scene: Path, steps: int, extra: Sequence[str]) -> Training:
    scene.unlink(missing_ok=True)
    scene.parent.mkdir(parents=True, exist_ok=True)
    chosen = {option.partition("=")[0]: option for option in (*schedule(steps), *extra)}
    command = [str(binary), str(photos), "--cpu", "--keep-crs", f"--output={scene}", *chosen.values()]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)
    assert process.stdout is not None
    loaded, said = None, [""]
    for line in process.stdout:
        if loaded is None and line.startswith("Step "):
            loaded = _processor_seconds(process.pid)
        said = [*said[-10:], line]
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode or loaded is None or not scene.is_file():
        raise RuntimeError(f"{' '.join(command)} failed: {''.join(said)}")
    return Training(scene, steps, usage.ru_utime + usage.ru_stime - loaded, usage.ru_maxrss * 1024)


def _processor_seconds(process: int) -> float:
    """Processor time of a running process so far."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
