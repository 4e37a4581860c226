"""Public interface of the renderer: one function, and a class that holds its options."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from vg2gt.geometry.spherical_harmonics import MAX_DEGREE
from vg2gt.memory import note_sizes
from vg2gt.rendering.cpu_tiles import rasterize_cpu
from vg2gt.rendering.dense import rasterize_dense
from vg2gt.rendering.footprints import make_footprints
from vg2gt.rendering.options import Mode, RenderOptions
from vg2gt.rendering.scenes import render_scenes
from vg2gt.rendering.selfcheck import require_trusted
from vg2gt.types import Cameras, Footprints, Gaussians, Render, check_choice

Implementation = Literal["auto", "dense", "cpu", "triton"]
MIN_SCALE = 1e-10  # smaller ones overflow the inverse covariance in float32


class UnrenderableError(ValueError):
    """Raised for values that are NaN, infinite or out of range; mismatched shapes raise a plain ValueError."""


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
        _check_shapes(gaussians, cameras)
        device = gaussians.means.device
        height, width = cameras.size
        scenes, views = cameras.world_to_camera.shape[:2]
        note_sizes({"Gaussians": len(gaussians), f"views of {height}x{width} to render": scenes * views})
        implementation = _resolve(self.implementation, device)
        dtype = torch.promote_types(gaussians.means.dtype, torch.float32)
        with torch.autocast(device.type, enabled=False):
            color = _background(background, gaussians, scenes, dtype)  # [1 or B, 3]
            if implementation != "triton":  # whose kernels check the values themselves
                _check_values(gaussians, cameras, color)
            gaussians, cameras = gaussians.map(_floats_to(dtype)), cameras.map(_floats_to(dtype))
            if implementation == "cpu":
                gaussians, cameras, color = gaussians.to("cpu"), cameras.to("cpu"), color.cpu()
            footprints = make_footprints(views, len(gaussians), gaussians.means, options)
            if implementation == "triton":
                out = _render_triton(gaussians, cameras, color, options, footprints)
            else:
                rasterize = rasterize_dense if implementation == "dense" else rasterize_cpu
                out = render_scenes(rasterize, gaussians, cameras, color.expand(scenes, 3), options, footprints)
            return replace(out.to(device), footprints=footprints)


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


def _render_triton(
    gaussians: Gaussians, cameras: Cameras, background: Tensor, options: RenderOptions, footprints: Footprints | None
) -> Render:
    """Renders with Triton, imported only here because CPU builds of torch lack it; ``background``: ``[1 or B, 3]``."""
    from vg2gt.rendering.gpu_tiles import RefusedError, render_triton

    # The kernels take one background for all scenes.
    one = len(background) == 1
    try:
        color = background[0] if one else background.new_zeros(3)
        render = render_triton(gaussians, cameras, color, options, footprints=footprints)
    except RefusedError:
        _check_values(gaussians, cameras, background)
        raise
    if one:
        return render
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


def _check_shapes(gaussians: Gaussians, cameras: Cameras) -> None:
    """Raises ValueError, naming the argument, if shapes do not match."""
    views, count = tuple(cameras.world_to_camera.shape[:2]), len(gaussians.means)
    coefficients = gaussians.sh.shape[1] if gaussians.sh.dim() == 3 else 0
    if coefficients not in {(degree + 1) ** 2 for degree in range(MAX_DEGREE + 1)}:
        raise ValueError(f"sh must be [G, (L + 1)^2, 3] with L from 0 to {MAX_DEGREE}, got {tuple(gaussians.sh.shape)}")
    of_cameras = {"world_to_camera": (*views, 4, 4), "intrinsics": (*views, 3, 3)}
    of_gaussians = {
        "means": (count, 3),
        "quats": (count, 4),
        "scales": (count, 3),
        "opacities": (count,),
        "sh": (count, coefficients, 3),
        "batch": (count,),
    }
    for record, expected in ((cameras, of_cameras), (gaussians, of_gaussians)):
        for name, shape in expected.items():
            found = tuple(getattr(record, name).shape)
            if found != shape:
                raise ValueError(f"{name} must be {list(shape)} for {count} Gaussians in {views} views, got {found}")


def _check_values(gaussians: Gaussians, cameras: Cameras, background: Tensor) -> None:
    """Raises ValueError unless all values are finite and in range and the Gaussians are sorted by scene."""
    _check_finite("world_to_camera", cameras.world_to_camera)
    _check_finite("intrinsics", cameras.intrinsics)
    _check_finite("background", background)
    focal = cameras.intrinsics[..., [0, 1], [0, 1]]
    _require("intrinsics", focal > 0, "be pinhole matrices with positive focal lengths")
    for name in ("means", "quats", "scales", "opacities", "sh"):
        _check_finite(name, getattr(gaussians, name))
    if len(gaussians) == 0:
        return
    # extremes first: one fast pass each, and enough in the common case
    scales, opacities, quats = (each.detach() for each in (gaussians.scales, gaussians.opacities, gaussians.quats))
    if not scales.amin() >= MIN_SCALE:
        _require("scales", scales >= MIN_SCALE, f"be at least {MIN_SCALE} (standard deviations in scene units)")
    if not (opacities.amin() >= 0 and opacities.amax() <= 1):
        _require("opacities", (opacities >= 0) & (opacities <= 1), "be in [0, 1]")
    if not quats.abs().amin() > 0:
        _require("quats", quats.abs().sum(-1) > 0, "have nonzero norm")
    batch, scenes = gaussians.batch, len(cameras.world_to_camera)
    if batch[0] < 0 or batch[-1] >= scenes or (batch[1:] < batch[:-1]).any():
        raise ValueError(
            f"batch must be sorted scene indices from 0 to {scenes - 1} (the cameras hold {scenes} scenes); "
            "sort the Gaussians by scene"
        )


def _check_finite(name: str, tensor: Tensor) -> None:
    """Raises UnrenderableError if a tensor holds NaN or infinity, naming it and the first bad position."""
    if torch.isfinite(tensor.detach().sum()):  # the common case in one fast pass
        return
    where = torch.nonzero(~torch.isfinite(tensor))
    if len(where):
        raise UnrenderableError(
            f"{name} holds {len(where)} NaN or infinite values, the first at {where[0].tolist()}; "
            "look for a diverging loss or an invalid input upstream"
        )


def _background(
    background: Tensor | Sequence[float] | None, gaussians: Gaussians, scenes: int, dtype: torch.dtype
) -> Tensor:
    """Returns the background ``[1 or B, 3]``: the given colour, else the Gaussians' own, else black."""
    own = gaussians.background if background is None else background
    if own is None:
        return gaussians.means.new_zeros(1, 3, dtype=dtype)
    color = torch.as_tensor(own, dtype=dtype, device=gaussians.means.device)
    if tuple(color.shape) not in ((3,), (scenes, 3)):
        raise ValueError(f"background must be one colour [3] or one per scene [{scenes}, 3], got {list(color.shape)}")
    return color.view(-1, 3)


def _require(name: str, good: Tensor, expectation: str) -> None:
    if not good.all():
        where = torch.nonzero(~good)
        raise UnrenderableError(f"{name} must {expectation}; {len(where)} do not, the first at {where[0].tolist()}")
