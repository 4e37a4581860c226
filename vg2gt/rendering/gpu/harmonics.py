"""Spherical harmonics inside Triton kernels (values: vg2gt/geometry/spherical_harmonics.py)."""

# pyright: reportGeneralTypeIssues=false, reportOperatorIssue=false
# (Triton's type hints do not cover the operators used inside kernels)

from __future__ import annotations

import triton  # pyright: ignore[reportMissingImports]
import triton.language as tl  # pyright: ignore[reportMissingImports]

_C0 = tl.constexpr(0.28209479177387814)
_C1 = tl.constexpr(0.4886025119029199)
_C2 = tl.constexpr(1.0925484305920792)
_C20 = tl.constexpr(0.31539156525252005)
_A = tl.constexpr(0.5900435899266435)
_B = tl.constexpr(2.890611442640554)
_D = tl.constexpr(0.4570457994644658)
_F = tl.constexpr(0.3731763325901154)
_E = tl.constexpr(1.445305721320277)


@triton.jit
def shade(p, x, y, z, there, degree: tl.constexpr):
    """Returns one colour channel along unit vectors; ``p`` points to its coefficients, with stride 3."""
    value = 0.5 + _C0 * tl.load(p, mask=there, other=0.0)
    if degree >= 1:
        value -= _C1 * y * tl.load(p + 3, mask=there, other=0.0)
        value += _C1 * z * tl.load(p + 6, mask=there, other=0.0)
        value -= _C1 * x * tl.load(p + 9, mask=there, other=0.0)
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        value += _C2 * x * y * tl.load(p + 12, mask=there, other=0.0)
        value -= _C2 * y * z * tl.load(p + 15, mask=there, other=0.0)
        value += _C20 * (2.0 * zz - xx - yy) * tl.load(p + 18, mask=there, other=0.0)
        value -= _C2 * x * z * tl.load(p + 21, mask=there, other=0.0)
        value += 0.5 * _C2 * (xx - yy) * tl.load(p + 24, mask=there, other=0.0)
        if degree >= 3:
            value -= _A * y * (3.0 * xx - yy) * tl.load(p + 27, mask=there, other=0.0)
            value += _B * x * y * z * tl.load(p + 30, mask=there, other=0.0)
            value -= _D * y * (4.0 * zz - xx - yy) * tl.load(p + 33, mask=there, other=0.0)
            value += _F * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * tl.load(p + 36, mask=there, other=0.0)
            value -= _D * x * (4.0 * zz - xx - yy) * tl.load(p + 39, mask=there, other=0.0)
            value += _E * z * (xx - yy) * tl.load(p + 42, mask=there, other=0.0)
            value -= _A * x * (xx - 3.0 * yy) * tl.load(p + 45, mask=there, other=0.0)
    return value


@triton.jit
def _term(p, grad, value, scale, there):
    """Adds a coefficient's gradient ``scale * value``; returns the coefficient times ``scale``."""
    tl.store(grad, tl.load(grad, mask=there, other=0.0) + scale * value, mask=there)
    return scale * tl.load(p, mask=there, other=0.0)


@triton.jit
def shade_backward(p, grad, g, x, y, z, there, degree: tl.constexpr):
    """Adds a channel's gradient ``g`` to those of its coefficients; returns the gradient of the direction."""
    tl.store(grad, tl.load(grad, mask=there, other=0.0) + _C0 * g, mask=there)
    gx, gy, gz = g * 0, g * 0, g * 0
    if degree >= 1:
        gy -= _C1 * _term(p + 3, grad + 3, -_C1 * y, g, there)
        gz += _C1 * _term(p + 6, grad + 6, _C1 * z, g, there)
        gx -= _C1 * _term(p + 9, grad + 9, -_C1 * x, g, there)
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        c = _C2 * _term(p + 12, grad + 12, _C2 * x * y, g, there)
        gx, gy = gx + c * y, gy + c * x
        c = -_C2 * _term(p + 15, grad + 15, -_C2 * y * z, g, there)
        gy, gz = gy + c * z, gz + c * y
        c = 2.0 * _C20 * _term(p + 18, grad + 18, _C20 * (2.0 * zz - xx - yy), g, there)
        gx, gy, gz = gx - c * x, gy - c * y, gz + 2.0 * c * z
        c = -_C2 * _term(p + 21, grad + 21, -_C2 * x * z, g, there)
        gx, gz = gx + c * z, gz + c * x
        c = _C2 * _term(p + 24, grad + 24, 0.5 * _C2 * (xx - yy), g, there)
        gx, gy = gx + c * x, gy - c * y
        if degree >= 3:
            c = -_A * _term(p + 27, grad + 27, -_A * y * (3.0 * xx - yy), g, there)
            gx, gy = gx + 6.0 * c * x * y, gy + 3.0 * c * (xx - yy)
            c = _B * _term(p + 30, grad + 30, _B * x * y * z, g, there)
            gx, gy, gz = gx + c * y * z, gy + c * x * z, gz + c * x * y
            c = -_D * _term(p + 33, grad + 33, -_D * y * (4.0 * zz - xx - yy), g, there)
            gx, gy, gz = gx - 2.0 * c * x * y, gy + c * (4.0 * zz - xx - 3.0 * yy), gz + 8.0 * c * y * z
            c = _F * _term(p + 36, grad + 36, _F * z * (2.0 * zz - 3.0 * xx - 3.0 * yy), g, there)
            gx, gy, gz = gx - 6.0 * c * x * z, gy - 6.0 * c * y * z, gz + c * (6.0 * zz - 3.0 * xx - 3.0 * yy)
            c = -_D * _term(p + 39, grad + 39, -_D * x * (4.0 * zz - xx - yy), g, there)
            gx, gy, gz = gx + c * (4.0 * zz - 3.0 * xx - yy), gy - 2.0 * c * x * y, gz + 8.0 * c * x * z
            c = _E * _term(p + 42, grad + 42, _E * z * (xx - yy), g, there)
            gx, gy, gz = gx + 2.0 * c * x * z, gy - 2.0 * c * y * z, gz + c * (xx - yy)
            c = -_A * _term(p + 45, grad + 45, -_A * x * (xx - 3.0 * yy), g, there)
            gx, gy = gx + 3.0 * c * (xx - yy), gy - 6.0 * c * x * y
    return gx, gy, gz
