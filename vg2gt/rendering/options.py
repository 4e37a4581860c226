"""Options of the renderer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vg2gt.types import check_choice, check_ranges

Mode = Literal["solid", "rasterized"]
DepthKind = Literal["median", "expected"]


@dataclass(frozen=True)
class RenderOptions:
    """Options common to all implementations.

    Attributes:
        mode: ``solid`` treats Gaussians as continuous stochastic solids (paper, Sec. Continuous Stochastic Solids
            Volume Rendering): exact ray maximum, median depth of the continuous transmittance. ``rasterized`` is
            classic 3DGS: affine splats, Jacobian clamped off-screen, piecewise constant transmittance.
        depth: ``median``: where transmittance falls to one half. In rasterized mode this is the z of the Gaussian at
            which it happens, with a gradient to that Gaussian's mean only. ``expected`` (rasterized only): blended z
            divided by alpha.
        near: near plane in scene units. Gaussians with a nearer mean are dropped; solid depth is never nearer.
        lowpass: variance in px^2 added to every screen footprint.
        antialiased: opacity is multiplied by the ratio of a footprint's area without and with the low-pass, so that
            what is smaller than a pixel fades instead of growing (2D filter of Mip-Splatting, `antialiased` of gsplat).
        alpha_max: upper bound of the opacity at a pixel; no gradient flows where it is reached.
        slope_floor: lower bound of ``-d ln T / dd`` in the median depth's gradient, in units of 1 / depth. It keeps
            plateaus of transmittance near one half from dominating; 0 gives the exact gradient.
        bisections: bisection steps of the solid median depth.
        newton_steps: Newton steps after the bisections; 0: bisections alone. The compiled renderers (CPU and GPU) mix
            both and stop at convergence; they are at least as accurate as these numbers give.
        geometry: False renders colour and alpha only; depth and normal are zero.
        footprints: also return positions, with their gradients, and radii of the Gaussians on the images.
        absgrad: the same, and sums over pixels of absolute gradients (AbsGS, `absgrad` of gsplat).

    Raises:
        ValueError: if an option is unknown or out of range; the message names it.
    """

    mode: Mode = "solid"
    depth: DepthKind = "median"
    near: float = 0.01
    lowpass: float = 0.3
    antialiased: bool = False
    alpha_max: float = 0.99
    slope_floor: float = 30.0
    bisections: int = 12
    newton_steps: int = 2
    geometry: bool = True
    footprints: bool = False
    absgrad: bool = False

    def __post_init__(self) -> None:
        check_choice("mode", self.mode, Mode)
        check_choice("depth", self.depth, DepthKind)
        if self.mode == "solid" and self.depth != "median":
            raise ValueError("solid rendering has median depth only; use depth=median or mode=rasterized")
        check_ranges(
            self,
            "",
            ("near", self.near > 0, "positive"),
            ("lowpass", self.lowpass >= 0, "at least 0"),
            ("alpha_max", 0 < self.alpha_max < 1, "between 0 and 1"),
            ("slope_floor", self.slope_floor >= 0, "at least 0"),
            ("bisections", self.bisections >= 1, "at least 1"),
            ("newton_steps", self.newton_steps >= 0, "at least 0"),
        )

    @property
    def search_steps(self) -> int:
        """Largest number of steps of the compiled renderers' search for the median depth."""
        # a Newton step may gain nothing: twice as many steps shrink the bracket at least as much as bisection alone
        return 2 * self.bisections + self.newton_steps if self.newton_steps else self.bisections
