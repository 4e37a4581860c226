"""Self-check of a device's compiled kernels against the reference, run once before their first use.

Two small fixed scenes are rendered by the kernels on the device and by the dense reference in float64 on the CPU. The
result is cached per device, driver, versions and sources.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import importlib.util
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import torch
from torch import Tensor

from vg2gt.geometry.rotations import quat_to_matrix
from vg2gt.io.files import read_json, write_json
from vg2gt.kernels.compiled import cache_folder
from vg2gt.rendering.dense import rasterize_dense
from vg2gt.rendering.options import Mode, RenderOptions
from vg2gt.rendering.scenes import render_scenes
from vg2gt.types import Cameras, Gaussians

VALUES = 5e-5  # largest allowed error of an image; float32 rounding gives about 2e-6
GRADIENTS = 5e-4  # largest allowed error of a gradient, relative to its norm; float32 rounding: about 1e-6
MODES: tuple[Mode, ...] = ("solid", "rasterized")
SCENES, COUNT, SIZE, VIEWS, _DEGREE = 2, 7, (9, 11), 2, 2  # COUNT: Gaussians per scene; _DEGREE: as in model=vg2gt
STREAM = 44  # seed of the scenes, with which three quarters of the rays have a well-conditioned depth
ROWS = 8  # gradient rows held at once: fewer than a view has, so that views are processed one by one
SOURCES = [path for files in ("gpu/*.py", "*.py") for path in sorted(Path(__file__).parent.glob(files))]
ADVICE = (
    "To render without these kernels (many times slower), use renderer.implementation=cpu (vg2gt reconstruct) "
    "or --device cpu (other commands)"
)


class KernelsRefusedError(ValueError):
    """Raised if a GPU's kernels are wrong, do not run or are missing; the user must choose to render without them."""


@dataclass(frozen=True)
class Agreement:
    """Errors of kernels against the reference.

    Attributes:
        values: largest absolute error of an image (depth in scene units; the scenes are about 3 deep).
        gradients: largest error of an input's gradient, relative to the gradient's norm.
    """

    values: float
    gradients: float

    @property
    def good(self) -> bool:
        """Whether both errors are within their bounds; False for NaN."""
        return self.values <= VALUES and self.gradients <= GRADIENTS

    def __str__(self) -> str:
        return (
            f"max image error {self.values:.1e} (limit {VALUES:g}), "
            f"max relative gradient error {self.gradients:.1e} (limit {GRADIENTS:g})"
        )


def require_trusted(device: torch.device) -> None:
    """Checks once that the Triton kernels agree with the reference on a device.

    Args:
        device: a CUDA or ROCm device.

    Raises:
        KernelsRefusedError: if they disagree with the reference, do not run, or Triton is not installed; the message
            says what to report and which option renders without them.
    """
    found_on = identity(device)
    if importlib.util.find_spec("triton") is None:
        raise KernelsRefusedError(f"rendering on {found_on} requires triton, which is not installed. {ADVICE}")
    if why := _refusal(found_on, str(device)):
        raise KernelsRefusedError(f"the Triton kernels {why}. Please report this line: {found_on}. {ADVICE}")


@lru_cache
def _refusal(found_on: str, device: str) -> str:
    """Returns what is wrong with the kernels, empty if nothing is; from the cache if they have been compared."""
    folder, known = cache_folder(), {}
    with suppress(OSError, ValueError):
        known = read_json(folder / "gpu_agreement.json") if folder else {}
    if found_on not in known:
        try:
            agreement = compare(torch.device(device))
        except Exception as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            return f"do not run ({type(error).__name__}: {reason[:300]})"
        known[found_on] = "" if agreement.good else f"disagree with the reference: {agreement}"
        with suppress(OSError):
            if folder:
                write_json(folder / "gpu_agreement.json", known)
    return known[found_on]


def identity(device: torch.device) -> str:
    """Returns the cache key of a result: device, driver, versions of torch and Triton, hash of the sources."""
    name, driver = device.type, ""
    if device.type == "cuda":
        name = torch.cuda.get_device_name(device)
        version = getattr(torch._C, "_cuda_getDriverVersion", None)
        driver = f"driver {version() if version else 'unknown'}, CUDA {torch.version.cuda or torch.version.hip}, "
    with suppress(importlib.metadata.PackageNotFoundError):
        driver += f"triton {importlib.metadata.version('triton')}, "
    source = hashlib.sha256(b"".join(path.read_bytes() for path in SOURCES))
    return f"{name}, {driver}torch {torch.__version__}, kernels {source.hexdigest()[:12]}"


def compare(device: torch.device, modes: tuple[Mode, ...] = MODES) -> Agreement:
    """Renders the fixed scenes with the kernels on ``device`` and with the reference, and returns the errors.

    Args:
        device: device that runs the kernels; a CPU if Triton interprets them.
        modes: render modes to compare.
    """
    worst = torch.zeros(2, dtype=torch.float64)
    # The first render may be part of an evaluation without gradients; the comparison needs them.
    with torch.inference_mode(False), torch.enable_grad(), torch.autocast(device.type, enabled=False):
        for mode in modes:
            (found, grads), (expected, expected_grads) = _run(mode, device), _run(mode, None)
            values = [(a - b).abs().max() for a, b in zip(found, expected, strict=True)]
            relative = [(a - b).norm() / b.norm() for a, b in zip(grads, expected_grads, strict=True)]
            worst = torch.maximum(worst, torch.stack((torch.stack(values).max(), torch.stack(relative).max())))
    return Agreement(*worst.tolist())


def _run(mode: Mode, device: torch.device | None) -> tuple[list[Tensor], list[Tensor]]:
    """Returns images of the kernels on a device (None: of the reference), and gradients of a weighted sum of them."""
    place = {"device": device or "cpu", "dtype": torch.float32 if device else torch.float64}
    inputs = [tensor.to(**place).requires_grad_() for tensor in _fixed_scene()]
    *parameters, poses, intrinsics, background = inputs
    batch = torch.arange(SCENES, device=device).repeat_interleave(COUNT)
    gaussians, cameras = Gaussians(*parameters, batch=batch), Cameras(poses, intrinsics, SIZE)
    options = RenderOptions(mode)
    if device is None:
        out = render_scenes(rasterize_dense, gaussians, cameras, background.expand(SCENES, 3), options)
    else:
        from vg2gt.rendering.gpu_tiles import render_triton

        out = render_triton(gaussians, cameras, background, options, rows=ROWS)
    images = [out.color, out.depth, out.normal, out.alpha]
    weights = [_numbers(image.numel(), 20 + index).view(image.shape).to(image) for index, image in enumerate(images)]
    grads = torch.autograd.grad(images, inputs, weights)
    return [image.detach().cpu().double() for image in images], [grad.cpu().double() for grad in grads]


def _fixed_scene() -> tuple[Tensor, ...]:
    """Returns means, quats, scales, opacities, sh, poses, intrinsics and background of the two scenes, in float64."""
    (height, width), total = SIZE, SCENES * COUNT
    depth = 2.5 + 1.2 * _numbers(total, STREAM)
    sides = torch.stack((0.45 * _numbers(total, STREAM + 1), 0.3 * _numbers(total, STREAM + 2)), -1) * depth[:, None]
    poses = torch.eye(4, dtype=torch.float64).repeat(SCENES, VIEWS, 1, 1)
    poses[:, 1, :3, :3] = quat_to_matrix(torch.tensor([1.0, 0.04, -0.05, 0.03], dtype=torch.float64))
    poses[:, 1, :3, 3] = torch.tensor([0.25, -0.15, 0.2])
    poses[1, :, 0, 3] += 0.1  # the two scenes have different cameras
    focal = torch.tensor([[20.0, 0, width / 2], [0, 19.0, height / 2], [0, 0, 1]], dtype=torch.float64)
    return (
        torch.cat((sides, depth[:, None]), -1),
        _numbers(4 * total, STREAM + 3).view(total, 4) + torch.tensor([0.2, 0, 0, 0], dtype=torch.float64),
        0.35 * torch.exp(0.7 * _numbers(3 * total, STREAM + 4)).view(total, 3),
        (0.8 + 0.6 * _numbers(total, STREAM + 5)).clamp(max=1.0),
        0.6 * _numbers(total * (_DEGREE + 1) ** 2 * 3, STREAM + 6).view(total, -1, 3),
        poses,
        focal.repeat(SCENES, VIEWS, 1, 1),
        torch.tensor([0.3, 0.1, 0.7], dtype=torch.float64),
    )


def _numbers(count: int, stream: int) -> Tensor:
    """Returns pseudo-random numbers in [-1, 1) that are the same everywhere, independent of torch's generators."""
    steps = torch.arange(1, count + 1, dtype=torch.float64) + 1000 * stream
    return 2 * torch.frac(steps * 0.6180339887498949 + torch.frac(steps * steps * 0.4142135623730951)) - 1
