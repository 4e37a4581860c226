"""Depth of rays, in particular the median depth through stochastic solids, with its implicit gradient.

A Gaussian of opacity alpha whose response peaks at ``t*`` with precision ``lambda`` is the solid of vacancy
``v(t) = sqrt(1 - g)``, ``g = alpha exp(-lambda (t - t*)^2 / 2)`` (paper, eqn vacancy). Its transmittance is
``sqrt(1 - g)`` up to the peak and ``(1 - alpha) / sqrt(1 - g)`` behind it. The transmittance T(t) of a ray is the
product over its Gaussians, in any order. The median depth d solves ``T(d) = 1/2``.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from vg2gt.rendering.constants import BRACKET_SIGMAS, MEDIAN_MAX_TRANSMITTANCE
from vg2gt.rendering.options import RenderOptions

_LOG_HALF = math.log(0.5)


def log_transmittance(t: Tensor, alpha: Tensor, peak: Tensor, precision: Tensor) -> Tensor:
    """Returns each hit's term of ``ln T(t)`` (paper, eqns volume_render and vacancy); ``[P, N]``."""
    occupied = torch.log1p(-alpha * torch.exp(-0.5 * precision * (t - peak) ** 2))
    return torch.where(t <= peak, 0.5 * occupied, torch.log1p(-alpha) - 0.5 * occupied)


def slope(t: Tensor, alpha: Tensor, peak: Tensor, precision: Tensor) -> Tensor:
    """Returns each hit's term of ``S = -d ln T / dt >= 0`` (paper, eqn sup_attenuation_coefficient)."""
    g = alpha * torch.exp(-0.5 * precision * (t - peak) ** 2)
    return 0.5 * g * precision * (t - peak).abs() / (1 - g)


class MedianDepth(torch.autograd.Function):
    """Median depth by bisection; gradient by the implicit-function theorem (paper, eqn tmed_grad)."""

    @staticmethod
    def forward(
        ctx: Any, alpha: Tensor, peak: Tensor, precision: Tensor, before: Tensor, options: RenderOptions
    ) -> Tensor:
        """Solves ``T(d) = 1/2`` for every ray; arguments as for :func:`ray_depth`.

        Returns:
            Depth ``[P]``; 0 where the final transmittance is 0.45 or more, or the median is nearer than ``near``.
        """

        def residual(t: Tensor) -> Tensor:
            return log_transmittance(t[:, None], alpha, peak, precision).sum(-1) - _LOG_HALF

        reach = BRACKET_SIGMAS / precision.sqrt()
        hit = alpha > 0
        inf = torch.full_like(peak, torch.inf)
        lo = torch.where(hit, peak - reach, inf).amin(-1).clamp(min=options.near)
        # if the hits up to here blend to at most 1/4, T is at most sqrt(1/4) = 1/2 behind their peaks
        near_hits = torch.where(hit & (before > 0.25), peak, -inf).amax(-1)
        all_hits = torch.where(hit, peak + reach, -inf).amax(-1)
        final = torch.log1p(-alpha).sum(-1).exp()
        hi = torch.where(final <= 0.25, near_hits, all_hits)
        solvable = final < MEDIAN_MAX_TRANSMITTANCE
        lo = torch.where(solvable, lo, torch.ones_like(lo))
        hi = torch.where(solvable, hi, torch.ones_like(hi))
        solvable &= residual(lo) > 0
        for _ in range(options.bisections):
            middle = 0.5 * (lo + hi)
            nearer = residual(middle) > 0
            lo, hi = torch.where(nearer, middle, lo), torch.where(nearer, hi, middle)
        depth = 0.5 * (lo + hi)
        tiny = torch.finfo(depth.dtype).tiny
        for _ in range(options.newton_steps):
            step = residual(depth) / slope(depth[:, None], alpha, peak, precision).sum(-1).clamp(min=tiny)
            depth = torch.minimum(torch.maximum(depth + step, lo), hi)
        depth = torch.where(solvable, depth, torch.zeros_like(depth))
        ctx.save_for_backward(alpha, peak, precision, depth)
        ctx.slope_floor = options.slope_floor
        return depth

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        """``dd/dtheta = -(dT/dtheta) / (dT/dd)``; ``dd/dt*`` is non-negative and sums to 1 over a ray."""
        alpha, peak, precision, depth = ctx.saved_tensors
        valid = depth > 0
        offset = depth[:, None] - peak
        bell = torch.exp(-0.5 * precision * offset**2)
        g = alpha * bell
        half = 0.5 / (1 - g)
        total = (half * g * precision * offset.abs()).sum(-1)
        floor = ctx.slope_floor / torch.where(valid, depth, torch.ones_like(depth))
        total = torch.maximum(total, floor).clamp(min=torch.finfo(total.dtype).tiny)
        factor = torch.where(valid, grad_outputs[0] / total, torch.zeros_like(depth))[:, None]
        passed = offset > 0
        grad_alpha = torch.where(passed, half * bell - 1 / (1 - alpha), -half * bell)
        grad_peak = half * g * precision * offset.abs()
        grad_precision = torch.where(passed, -0.5, 0.5) * half * g * offset**2
        return factor * grad_alpha, factor * grad_peak, factor * grad_precision, None, None


def ray_depth(
    alpha: Tensor,
    weight: Tensor,
    before: Tensor,
    final: Tensor,
    peak: Tensor,
    precision: Tensor,
    options: RenderOptions,
) -> Tensor:
    """Returns the depth ``[P]`` of every ray, as ``options.mode`` and ``options.depth`` select; 0 where a ray has none.

    Rasterised expected depth is the paper's eqn sup_gs_depth_render.

    Args:
        alpha: ``[P, N]`` opacity of every Gaussian on every ray, 0 where it is not hit.
        weight: ``[P, N]`` blending weight.
        before: ``[P, N]`` transmittance in front in blending order, without gradient.
        final: ``[P]`` transmittance of every ray.
        peak: ``[P, N]`` depth of the response's peak.
        precision: ``[P, N]`` inverse variance along the ray.
        options: mode, kind of depth, and the solver's settings.
    """
    if options.mode == "solid":
        depth = MedianDepth.apply(alpha, peak, precision, before, options)
        assert isinstance(depth, Tensor)
        return depth
    if options.depth == "expected":
        covered = 1 - final
        hit = covered.detach() > 0
        return torch.where(hit, (weight * peak).sum(-1) / torch.where(hit, covered, 1.0), 0.0)
    crossing = (before > 0.5) & (before * (1 - alpha.detach()) <= 0.5)
    return (crossing * peak).sum(-1)


def depth_factors(
    grad_depth: Tensor, grad_alpha: Tensor, depth: Tensor, slope: Tensor, transmittance: Tensor, options: RenderOptions
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Converts the gradient of depth images ``[V, H, W]`` into the inputs of the compiled backward kernels.

    Returns:
        Depth gradient divided by S (solid; paper, eqn tmed_grad), divided by alpha (expected), and at the crossing
        (rasterized median), each 0 in the other cases; and the gradient of alpha.
    """
    zero, valid = torch.zeros_like(depth), depth > 0
    if options.mode == "solid":
        floor = torch.full_like(depth, options.slope_floor) / torch.where(valid, depth, 1.0)
        bound = torch.maximum(slope, floor).clamp(min=torch.finfo(depth.dtype).tiny)
        return torch.where(valid, grad_depth / bound, 0.0), zero, zero, grad_alpha
    if options.depth == "expected":
        factor = torch.where(valid, grad_depth / torch.where(valid, 1 - transmittance, 1.0), 0.0)
        return zero, factor, zero, grad_alpha - factor * depth
    return zero, zero, torch.where(valid, grad_depth, 0.0), grad_alpha
