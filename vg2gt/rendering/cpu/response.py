"""A Gaussian's response along a ray, once for the compiled forward and backward pass."""

from __future__ import annotations

from vg2gt.io.compiled import kernel_part
from vg2gt.io.compiled_math import exp
from vg2gt.rendering.cpu.constants import FAST, ONE, ZERO


@kernel_part(fastmath=FAST, error_model="numpy", forceinline=True)
def respond(dx, before, g, s_row, e_row, f_row):
    """A Gaussian's response along a ray (rendering/projection.py): E, 1 + s, r, and whether it counts.

    ``g`` holds what the formula needs of the Gaussian: Q_xx, q_x, eps, cutoff; the rest depends on the row alone.
    """
    qa, q0, eps, cutoff = g
    e = (qa * dx + f_row) * dx + e_row
    s = q0 * dx + s_row
    r = s * s + eps * e
    return e, s, r, (e <= cutoff * r) & (s > ZERO) & (before > ZERO)


@kernel_part(fastmath=FAST, error_model="numpy", forceinline=True)
def attenuate(exponent, on, before, opacity, alpha_max, stop):
    """Opacity at the pixel, 0 where the hit does not count or stops the ray; transmittance behind; its next state."""
    full = min(opacity * exp(exponent), alpha_max)
    full = full if on else ZERO
    after = before * (ONE - full)
    stopped = on & (after < stop)
    return ZERO if stopped else full, after, -before if stopped else after
