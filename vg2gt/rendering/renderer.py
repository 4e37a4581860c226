"""The renderer's public surface: one function, and a class that holds its options."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Literal, get_args

import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.geometry.cameras import invert_rigid
from vg2gt.geometry.spherical_harmonics import sh_to_rgb
from vg2gt.rendering.checks import background_color, check_cameras, check_gaussians
from vg2gt.rendering.cpu import rasterize_cpu
from vg2gt.rendering.dense import rasterize_dense
from vg2gt.rendering.options import DepthKind, Images, Mode, RenderOptions, SceneViews
from vg2gt.rendering.pairs import rasterize_pairs
from vg2gt.types import Cameras, Gaussians, Render

Implementation = Literal["auto", "torch", "dense", "cpu", "triton"]
Rasterizer = Callable[[SceneViews, RenderOptions], Images]


def _rasterize_triton(scene: SceneViews, options: RenderOptions) -> Images:
    """Imports Triton only when it is asked for: torch's CPU builds come without it."""
    if importlib.util.find_spec("triton") is None:
        raise ValueError(
            "implementation 'triton' needs the package triton; install a CUDA build of torch or use 'torch'"
        )
    from vg2gt.rendering.gpu import rasterize_triton

    return rasterize_triton(scene, options)


RASTERIZERS: dict[str, Rasterizer] = {
    "torch": rasterize_pairs,
    "dense": rasterize_dense,
    "cpu": rasterize_cpu,
    "triton": _rasterize_triton,
}


def render(
    gaussians: Gaussians,
    cameras: Cameras,
    mode: Mode = "solid",
    background: Tensor | Sequence[float] | None = None,
    near: float = 0.01,
    *,
    implementation: Implementation = "auto",
    depth: DepthKind = "median",
    lowpass: float = 0.3,
    alpha_max: float = 0.99,
    slope_floor: float = 30.0,
    bisections: int = 12,
    newton_steps: int = 2,
    geometry: bool = True,
) -> Render:
    """Renders the Gaussians of B scenes into V views each.

    Differentiable in means, quats, scales, opacities, sh, world_to_camera, intrinsics and background. Everything is
    computed in the Gaussians' dtype, in float32 at least, whatever the autocast dtype.

    Args:
        gaussians: G Gaussians, packed over the B scenes and sorted by scene.
        cameras: the views ``[B, V]``; skew and distortion are not modelled.
        mode: ``solid`` treats Gaussians as continuous stochastic solids (paper, Sec. Continuous Stochastic Solids
            Volume Rendering): exact ray maximum, median depth of the continuous transmittance. ``rasterized`` is
            classic 3DGS: affine splats, Jacobian clamped off-screen, piecewise constant transmittance.
        background: one colour ``[3]``; None is black.
        near: Gaussians whose mean is nearer are dropped; solid depth is never in front of it. Scene units.
        implementation: ``cpu`` compiled tile renderer; ``triton`` the same for CUDA devices; ``torch`` sparse pairs on
            any device; ``dense`` the slow reference; ``auto`` chooses ``cpu`` on CPU and ``torch`` elsewhere.
        depth: ``median``: where transmittance falls to one half; rasterized, that is the z of the Gaussian at which it
            happens, with gradient to that Gaussian's mean only. ``expected`` (rasterized only): blended z over alpha.
        lowpass: variance in px^2 added to every screen footprint.
        alpha_max: cap of the opacity at a pixel; no gradient passes where it acts.
        slope_floor: lower bound of ``-d ln T / dd``, in units of 1 / depth, used in the median depth's gradient so that
            plateaus of transmittance near one half do not dominate; 0 gives the exact gradient.
        bisections: bisection steps of the solid median depth.
        newton_steps: Newton steps after the bisections.
        geometry: False renders colour and alpha only; depth and normal are zero.

    Returns:
        Views ``[B, V, ...]`` in the Gaussians' dtype (float32 at least). Solid depth is 0 where a ray's final
        transmittance is 0.45 or more or its median lies in front of ``near``; rasterized median depth where it never
        falls to 0.5; expected depth where alpha is 0.

    Raises:
        ValueError: on shapes that disagree, NaN or infinite values, scales that are not positive, unknown options.
    """
    options = RenderOptions(mode, depth, near, lowpass, alpha_max, slope_floor, bisections, newton_steps, geometry)
    _check_options(options, implementation)
    check_cameras(cameras)
    scenes = len(cameras.world_to_camera)
    check_gaussians(gaussians, scenes)
    device = gaussians.means.device
    if cameras.world_to_camera.device != device:
        raise ValueError(
            f"cameras are on {cameras.world_to_camera.device}, the Gaussians on {device}; move one of them"
        )
    rasterize = RASTERIZERS[_resolve(implementation, device)]
    dtype = torch.promote_types(gaussians.means.dtype, torch.float32)
    with torch.autocast(device.type, enabled=False):
        gaussians, cameras = gaussians.map(_floats_to(dtype)), cameras.map(_floats_to(dtype))
        color = background_color(background, like=gaussians.means)
        images = [rasterize(_scene_views(gaussians.scene(b), cameras, b, color), options) for b in range(scenes)]
    stacked = {field.name: torch.stack([getattr(image, field.name) for image in images]) for field in fields(Images)}
    return Render(
        color=stacked["color"].permute(0, 1, 4, 2, 3),
        depth=stacked["depth"],
        normal=stacked["normal"].permute(0, 1, 4, 2, 3),
        alpha=stacked["alpha"],
    )


class Renderer:
    """A renderer with its options fixed; calling it renders.

    Args:
        mode: ``solid`` or ``rasterized``.
        near: near plane in scene units.
        implementation: ``auto``, ``cpu``, ``triton``, ``torch`` or ``dense``.
        depth: ``median``, or ``expected`` with ``rasterized``.
        lowpass: variance in px^2 added to every screen footprint.
        alpha_max: cap of the opacity at a pixel.
        slope_floor: bound of the median depth's gradient, see :func:`render`.
        bisections: bisection steps of the solid median depth.
        newton_steps: Newton steps after them.
        geometry: False renders colour and alpha only.
    """

    def __init__(
        self,
        mode: Mode = "solid",
        near: float = 0.01,
        implementation: Implementation = "auto",
        depth: DepthKind = "median",
        lowpass: float = 0.3,
        alpha_max: float = 0.99,
        slope_floor: float = 30.0,
        bisections: int = 12,
        newton_steps: int = 2,
        geometry: bool = True,
    ) -> None:
        self.options = RenderOptions(
            mode, depth, near, lowpass, alpha_max, slope_floor, bisections, newton_steps, geometry
        )
        self.implementation: Implementation = implementation
        _check_options(self.options, implementation)

    def __call__(
        self,
        gaussians: Gaussians,
        cameras: Cameras,
        background: Tensor | Sequence[float] | None = None,
        mode: Mode | None = None,
    ) -> Render:
        """Renders ``gaussians`` into ``cameras`` (see :func:`render`); ``mode`` overrides the renderer's own.

        An overriding mode ``solid`` always has median depth, the only one it knows.
        """
        options = self.options
        mode = mode or options.mode
        return render(
            gaussians,
            cameras,
            mode,
            background,
            options.near,
            implementation=self.implementation,
            depth=options.depth if mode == "rasterized" else "median",
            lowpass=options.lowpass,
            alpha_max=options.alpha_max,
            slope_floor=options.slope_floor,
            bisections=options.bisections,
            newton_steps=options.newton_steps,
            geometry=options.geometry,
        )


def _scene_views(gaussians: Gaussians, cameras: Cameras, scene: int, background: Tensor) -> SceneViews:
    """One scene with its colours seen from every view (one copy where they do not depend on it)."""
    poses = cameras.world_to_camera[scene]
    if gaussians.sh.shape[1] == 1:
        directions = gaussians.means[None]  # a constant colour does not look at them
    else:
        centers = invert_rigid(poses)[:, None, :3, 3]
        directions = F.normalize(gaussians.means - centers, dim=-1)
    return SceneViews(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        sh_to_rgb(gaussians.sh, directions),
        poses,
        cameras.intrinsics[scene],
        background,
        cameras.size,
    )


def _resolve(implementation: Implementation, device: torch.device) -> str:
    if implementation == "auto":
        return "cpu" if device.type == "cpu" else "torch"
    if implementation == "cpu" and device.type != "cpu":
        raise ValueError(f"implementation 'cpu' needs tensors on the CPU, these are on {device}; use 'auto' or 'torch'")
    if implementation == "triton" and device.type != "cuda" and os.environ.get("TRITON_INTERPRET") != "1":
        raise ValueError(f"implementation 'triton' needs tensors on a CUDA device, these are on {device}; use 'auto'")
    return implementation


def _floats_to(dtype: torch.dtype) -> Callable[[Tensor], Tensor]:
    return lambda tensor: tensor.to(dtype) if tensor.is_floating_point() else tensor


def _check_options(options: RenderOptions, implementation: str) -> None:
    for name, value, allowed in (
        ("mode", options.mode, get_args(Mode)),
        ("depth", options.depth, get_args(DepthKind)),
        ("implementation", implementation, get_args(Implementation)),
    ):
        if value not in allowed:
            raise ValueError(f"{name} must be one of {', '.join(allowed)}, got {value!r}")
    if options.mode == "solid" and options.depth != "median":
        raise ValueError("solid rendering has median depth only; use depth=median or mode=rasterized")
    for name, good, expected in (
        ("near", options.near > 0, "positive"),
        ("lowpass", options.lowpass >= 0, "at least 0"),
        ("alpha_max", 0 < options.alpha_max < 1, "between 0 and 1"),
        ("slope_floor", options.slope_floor >= 0, "at least 0"),
        ("bisections", options.bisections >= 1, "at least 1"),
        ("newton_steps", options.newton_steps >= 0, "at least 0"),
    ):
        if not good:
            raise ValueError(f"{name} must be {expected}, got {getattr(options, name)}")
