"""OpenSplat's CPU rasteriser as a peer of ours: ``python benchmarks/render.py --opensplat CHECKOUT``.

Its source stays in its own checkout (AGPL) and what is compiled of it in torch's folder of extensions; here is only how
it is called. It renders colour alone, and no gradient reaches what hides a Gaussian but the Gaussian itself.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor
from torch.utils.cpp_extension import load_inline

from vg2gt.geometry.spherical_harmonics import DC
from vg2gt.types import Cameras, Gaussians

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
