"""Public interface of the renderer: one function, and a class that holds its options."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from vg2gt.memory import note_sizes
from vg2gt.rendering.checks import background_colors, check_finite, check_shapes, check_values
from vg2gt.rendering.cpu_tiles import rasterize_cpu
from vg2gt.rendering.dense import rasterize_dense
from vg2gt.rendering.options import Mode, RenderOptions, check_choice
from vg2gt.rendering.scenes import render_scenes
from vg2gt.rendering.selfcheck import require_trusted
from vg2gt.types import Cameras, Gaussians, Render

Implementation = Literal["auto", "dense", "cpu", "triton"]


@dataclass(frozen=True)
class Renderer(RenderOptions):
    """A renderer with its options fixed; calling it renders.

    Attributes:
        implementation: ``cpu``: compiled tile renderer; renders scenes of other devices on the CPU. ``triton``: the
            same for CUDA devices. ``dense``: the slow reference, on any device. ``auto``: ``triton`` on CUDA devices,
            after a check against the reference (:mod:`vg2gt.rendering.selfcheck`); ``cpu`` elsewhere.
    """

    implementation: Implementation = "auto"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("implementation", self.implementation, Implementation)

    def __call__(
        self,
        gaussians: Gaussians,
        cameras: Cameras,
        background: Tensor | Sequence[float] | None = None,
        mode: Mode | None = None,
    ) -> Render:
        """Renders ``gaussians`` into ``cameras`` (see :func:`render`); ``mode`` overrides the renderer's own.

        If ``mode`` is ``solid``, depth is always the median.
        """
        options = self
        if mode is not None:
            options = replace(self, mode=mode, depth="median" if mode == "solid" else self.depth)
        check_shapes(gaussians, cameras)
        device = gaussians.means.device
        height, width = cameras.size
        scenes, views = cameras.world_to_camera.shape[:2]
        note_sizes({"Gaussians": len(gaussians), f"views of {height}x{width} to render": scenes * views})
        implementation = _resolve(self.implementation, device)
        dtype = torch.promote_types(gaussians.means.dtype, torch.float32)
        with torch.autocast(device.type, enabled=False):
            color = background_colors(background, gaussians, scenes, dtype)  # [B, 3]
            if implementation == "triton":
                one = scenes == 1 or background is not None or gaussians.background is None
                gaussians, cameras = gaussians.map(_floats_to(dtype)), cameras.map(_floats_to(dtype))
                return _render_triton(gaussians, cameras, color[:1] if one else color, options)
            check_values(gaussians, cameras)
            check_finite("background", color)
            gaussians, cameras = gaussians.map(_floats_to(dtype)), cameras.map(_floats_to(dtype))
            if implementation == "dense":
                return render_scenes(rasterize_dense, gaussians, cameras, color, options)
            host = (gaussians.to("cpu"), cameras.to("cpu"), color.cpu())
            return render_scenes(rasterize_cpu, *host, options).to(device)


def render(
    gaussians: Gaussians,
    cameras: Cameras,
    mode: Mode = "solid",
    background: Tensor | Sequence[float] | None = None,
    near: float = 0.01,
    **options: Any,
) -> Render:
    """Renders the Gaussians of B scenes into V views each.

    Differentiable in means, quats, scales, opacities, sh, world_to_camera, intrinsics and background. Computes in the
    Gaussians' dtype, at least float32, regardless of autocast.

    Args:
        gaussians: G Gaussians, packed over the B scenes and sorted by scene.
        cameras: views ``[B, V]`` to render; skew and distortion are not modelled.
        mode: ``solid`` or ``rasterized``.
        background: one colour ``[3]``; None: the Gaussians' own background, or black.
        near: near plane in scene units.
        **options: ``implementation`` (:class:`Renderer`) and the other fields of :class:`RenderOptions`.

    Returns:
        Views ``[B, V, ...]`` in the Gaussians' dtype (at least float32). Solid depth is 0 where a ray's final
        transmittance is 0.45 or more or its median is nearer than ``near``. Rasterized median depth is 0 where
        transmittance never falls to 0.5, expected depth where alpha is 0.

    Raises:
        ValueError: if shapes do not match, values are NaN, infinite or out of range, or an option is unknown.
    """
    return Renderer(mode=mode, near=near, **options)(gaussians, cameras, background)


def _render_triton(gaussians: Gaussians, cameras: Cameras, background: Tensor, options: RenderOptions) -> Render:
    """Renders with Triton, imported only here because CPU builds of torch lack it; ``background``: ``[1 or B, 3]``."""
    if importlib.util.find_spec("triton") is None:
        raise ValueError("implementation 'triton' needs the package triton; install a CUDA build of torch or use 'cpu'")
    from vg2gt.rendering.gpu_tiles import RefusedError, render_triton

    black = background.new_zeros(3)
    try:
        if len(background) == 1:
            return render_triton(gaussians, cameras, background[0], options)
        render = render_triton(gaussians, cameras, black, options)
    except RefusedError:
        check_values(gaussians, cameras)
        check_finite("background", background)
        raise
    # The kernels take one background for all scenes.
    behind = (1 - render.alpha)[:, :, None] * background[:, None, :, None, None]
    return replace(render, color=render.color + behind)


def _resolve(implementation: Implementation, device: torch.device) -> str:
    if implementation == "auto":
        return automatic(device)
    if implementation == "triton" and device.type != "cuda" and os.environ.get("TRITON_INTERPRET") != "1":
        raise ValueError(f"implementation 'triton' requires CUDA tensors, got {device}; use 'auto'")
    return implementation


def automatic(device: torch.device) -> str:
    """Returns the implementation that ``auto`` selects for a device; the kernels of a CUDA device are checked once.

    Raises:
        KernelsRefusedError: if the kernels fail the check on a CUDA device.
    """
    if device.type == "cuda":
        require_trusted(device)
        return "triton"
    return "cpu"


def _floats_to(dtype: torch.dtype) -> Callable[[Tensor], Tensor]:
    return lambda tensor: tensor.to(dtype) if tensor.is_floating_point() else tensor
