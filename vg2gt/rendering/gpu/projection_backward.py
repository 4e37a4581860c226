"""Triton kernel that chains gradients of views to Gaussians and cameras: the backward pass of ``projection.py``.

One lane per Gaussian sums over its views in registers: there are no atomics, and sums have a fixed order.
"""

# pyright: reportGeneralTypeIssues=false, reportOperatorIssue=false
# (Triton's type hints do not cover the operators and ranges used inside kernels)

from __future__ import annotations

import triton  # pyright: ignore[reportMissingImports]
import triton.language as tl  # pyright: ignore[reportMissingImports]

from vg2gt.rendering.constants import COMPENSATION_FLOOR
from vg2gt.rendering.gpu.harmonics import shade_backward
from vg2gt.rendering.gpu.projection import (
    BLOCK,
    CLAMP,
    TINY,
    along_axis,
    compensation,
    load_pose,
    rotation,
)
from vg2gt.rendering.gpu.tiles import RECORD

CAMERA = 25  # gradients of a view: pose 16, intrinsics 9

_BLOCK = tl.constexpr(BLOCK)
_RECORD = tl.constexpr(RECORD)
_CAMERA = tl.constexpr(CAMERA)
_TINY = tl.constexpr(TINY)
_CLAMP = tl.constexpr(CLAMP)
_FLOOR = tl.constexpr(COMPENSATION_FLOOR)


@triton.jit
def _axis_backward(b0, b1, b2, scale, fx, fy, u, v, us, vs, iz, jx, jy, h, s_xx, s_xy, s_yy, l0, l1, l2, ga0):
    """Returns gradients of one axis: camera-frame axis (3), scale, Jacobian products (2) and slopes (2), u, v."""
    inverse = 1.0 / scale
    gjx, gjy = 2.0 * (s_xx * jx + s_xy * jy), 2.0 * (s_xy * jx + s_yy * jy)
    px, py = gjx * scale * fx * iz, gjy * scale * fy * iz
    w = h * inverse
    gw = l0 * b0 + l1 * b1 + l2 * b2
    gh = (gw * inverse + 2.0 * h * ga0) * inverse
    g0, g1, g2 = px + w * l0 + gh * u, py + w * l1 + gh * v, w * l2 + gh - px * us - py * vs
    gjx, gjy = gjx * jx, gjy * jy
    return g0, g1, g2, (gjx + gjy - gw * w) * inverse - gh * h, gjx, gjy, -px * b2, -py * b2, gh * b0, gh * b1


@triton.jit(do_not_specialize=("total", "views", "scenes", "height", "width", "first_view", "some_views", "base"))
def project_backward_kernel(
    means, quats, scales, opacities, sh, batch, poses, intrinsics, records, ends, rows,
    grad_means, grad_quats, grad_scales, grad_opacities, grad_sh, grad_cameras,
    total, views, scenes, height, width, first_view, some_views, base,
    lowpass: tl.constexpr, solid: tl.constexpr, antialiased: tl.constexpr, degree: tl.constexpr, cameras: tl.constexpr,
):  # fmt: skip
    """Sums the gradient rows of a block of Gaussians over tiles and views, and adds the chained gradients.

    Covers ``some_views`` views of each scene, from ``first_view`` on; their rows begin at ``base``. With ``cameras``,
    each (block, view) writes its sum of the gradients of that view's pose and intrinsics.
    """
    first = tl.program_id(0) * _BLOCK
    i = first + tl.arange(0, _BLOCK)
    there = i < total
    i = tl.where(there, i, 0).to(tl.int64)
    scene = tl.load(batch + i)
    m0, m1, m2 = tl.load(means + 3 * i), tl.load(means + 3 * i + 1), tl.load(means + 3 * i + 2)
    s0, s1, s2 = tl.load(scales + 3 * i), tl.load(scales + 3 * i + 1), tl.load(scales + 3 * i + 2)
    qw, qx = tl.load(quats + 4 * i), tl.load(quats + 4 * i + 1)
    qy, qz = tl.load(quats + 4 * i + 2), tl.load(quats + 4 * i + 3)
    norm = 1.0 / tl.sqrt(tl.maximum(qw * qw + qx * qx + qy * qy + qz * qz, _TINY))
    qw, qx, qy, qz = qw * norm, qx * norm, qy * norm, qz * norm
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation(qw, qx, qy, qz)
    coefficients = i * (3 * (degree + 1) * (degree + 1))
    zero = m0 * 0
    gm0, gm1, gm2, gs0, gs1, gs2, go = zero, zero, zero, zero, zero, zero, zero
    d00, d01, d02, d10, d11, d12, d20, d21, d22 = zero, zero, zero, zero, zero, zero, zero, zero, zero
    current, final = tl.load(batch + first), tl.load(batch + tl.minimum(first + _BLOCK, total) - 1)
    while current <= final:
        v = first_view
        while v < first_view + some_views:
            slot = i + tl.cast(v, tl.int64) * total
            mine = there & (scene == current)
            place = tl.load(ends + slot - 1, mask=mine & (slot > 0), other=0)
            count = tl.where(mine, tl.load(ends + slot, mask=mine, other=0) - place, 0)
            most = tl.max(count, 0)
            if most > 0:
                row = rows + (place - base) * _RECORD
                # sum over tiles
                a0, a1, a2, a3, a4, a5, a6, a7 = zero, zero, zero, zero, zero, zero, zero, zero
                a8, a9, a10, a11, a12, a13, a14, a15 = zero, zero, zero, zero, zero, zero, zero, zero
                k = 0
                while k < most:
                    on = k < count
                    a0 += tl.load(row, mask=on, other=0.0)
                    a1 += tl.load(row + 1, mask=on, other=0.0)
                    a2 += tl.load(row + 2, mask=on, other=0.0)
                    a3 += tl.load(row + 3, mask=on, other=0.0)
                    a4 += tl.load(row + 4, mask=on, other=0.0)
                    a5 += tl.load(row + 5, mask=on, other=0.0)
                    a6 += tl.load(row + 6, mask=on, other=0.0)
                    a7 += tl.load(row + 7, mask=on, other=0.0)
                    a8 += tl.load(row + 8, mask=on, other=0.0)
                    a9 += tl.load(row + 9, mask=on, other=0.0)
                    a10 += tl.load(row + 10, mask=on, other=0.0)
                    a11 += tl.load(row + 11, mask=on, other=0.0)
                    a12 += tl.load(row + 12, mask=on, other=0.0)
                    a13 += tl.load(row + 13, mask=on, other=0.0)
                    a14 += tl.load(row + 14, mask=on, other=0.0)
                    a15 += tl.load(row + 15, mask=on, other=0.0)
                    row += _RECORD
                    k += 1
                # recompute the projection
                act = count > 0
                view = current * views + v
                w00, w01, w02, w10, w11, w12, w20, w21, w22, t0, t1, t2 = load_pose(poses + view * 16)
                fx, fy = tl.load(intrinsics + view * 9), tl.load(intrinsics + view * 9 + 4)
                ifx, ify = 1.0 / fx, 1.0 / fy
                x, y = w00 * m0 + w01 * m1 + w02 * m2 + t0, w10 * m0 + w11 * m1 + w12 * m2 + t1
                z = tl.where(act, w20 * m0 + w21 * m1 + w22 * m2 + t2, 1.0)
                iz = 1.0 / z
                u, v_ = x * iz, y * iz
                us, vs = u, v_
                if not solid:
                    x_limit, y_limit = (width / fx) * _CLAMP, (height / fy) * _CLAMP  # the tensor first, for Triton 3.7
                    us = tl.minimum(tl.maximum(u, -x_limit), x_limit)
                    vs = tl.minimum(tl.maximum(v_, -y_limit), y_limit)
                b00, b10, b20, jx0, jy0, h0 = along_axis(
                    w00, w01, w02, w10, w11, w12, w20, w21, w22, r00, r10, r20, s0, fx, fy, u, v_, us, vs, iz
                )
                b01, b11, b21, jx1, jy1, h1 = along_axis(
                    w00, w01, w02, w10, w11, w12, w20, w21, w22, r01, r11, r21, s1, fx, fy, u, v_, us, vs, iz
                )
                b02, b12, b22, jx2, jy2, h2 = along_axis(
                    w00, w01, w02, w10, w11, w12, w20, w21, w22, r02, r12, r22, s2, fx, fy, u, v_, us, vs, iz
                )
                xx, yy = lowpass + jx0 * jx0 + jx1 * jx1 + jx2 * jx2, lowpass + jy0 * jy0 + jy1 * jy1 + jy2 * jy2
                xy = jx0 * jy0 + jx1 * jy1 + jx2 * jy2
                idet = 1.0 / tl.where(act, xx * yy - xy * xy, 1.0)
                qa, qb, qc = yy * idet, -xy * idet, xx * idet
                # conic -> screen covariance: -Q dQ Q
                a3 *= 0.5
                k00, k01, k10, k11 = qa * a2 + qb * a3, qa * a3 + qb * a4, qb * a2 + qc * a3, qb * a3 + qc * a4
                s_xx, s_xy, s_yy = -(k00 * qa + k01 * qb), -(k00 * qb + k01 * qc), -(k10 * qb + k11 * qc)
                if antialiased:  # a9 is the gradient of the log of the compensated opacity
                    sharp, share = compensation(jx0, jy0, jx1, jy1, jx2, jy2, xx + yy, lowpass)
                    drawn = act & (share > _FLOOR)
                    half, isharp = tl.where(drawn, 0.5 * a9, 0.0), 1.0 / tl.where(drawn, sharp, 1.0)
                    s_xx += half * ((yy - lowpass) * isharp - qa)
                    s_xy += half * (-xy * isharp - qb)
                    s_yy += half * ((xx - lowpass) * isharp - qc)
                ia0 = 1.0 / tl.where(act, h0 * h0 + h1 * h1 + h2 * h2, 1.0)
                e0, e1, e2 = h0 / s0 * ia0, h1 / s1 * ia0, h2 / s2 * ia0
                p0, p1 = b00 * e0 + b01 * e1 + b02 * e2, b10 * e0 + b11 * e1 + b12 * e2
                p2 = b20 * e0 + b21 * e1 + b22 * e2
                gu, gv, gz = fx * a0, fy * a1, a7
                gfx, gfy = u * a0, v_ * a1
                # through p = L m / a0: the tilt p_xy / f and the normal -p / |p|
                l0, l1, l2 = zero, zero, zero
                if solid:
                    l0, l1 = a5 * ifx, a6 * ify
                    gfx -= l0 * p0 * ifx
                    gfy -= l1 * p1 * ify
                length = 1.0 / tl.sqrt(tl.where(act, p0 * p0 + p1 * p1 + p2 * p2, 1.0))
                n0, n1, n2 = -p0 * length, -p1 * length, -p2 * length
                along = a10 * n0 + a11 * n1 + a12 * n2
                l0 -= (a10 - n0 * along) * length
                l1 -= (a11 - n1 * along) * length
                l2 -= (a12 - n2 * along) * length
                ga0 = a8 - (l0 * p0 + l1 * p1 + l2 * p2) * ia0
                l0, l1, l2 = l0 * ia0, l1 * ia0, l2 * ia0
                a00, a10_, a20, gs, gx0, gy0, gus, gvs, gu0, gv0 = _axis_backward(
                    b00, b10, b20, s0, fx, fy, u, v_, us, vs, iz, jx0, jy0, h0, s_xx, s_xy, s_yy, l0, l1, l2, ga0
                )
                gs0 += gs
                gjx, gjy, gu, gv, sum_us, sum_vs = gx0, gy0, gu + gu0, gv + gv0, gus, gvs
                a01, a11_, a21, gs, gx0, gy0, gus, gvs, gu0, gv0 = _axis_backward(
                    b01, b11, b21, s1, fx, fy, u, v_, us, vs, iz, jx1, jy1, h1, s_xx, s_xy, s_yy, l0, l1, l2, ga0
                )
                gs1 += gs
                gjx, gjy, gu, gv = gjx + gx0, gjy + gy0, gu + gu0, gv + gv0
                sum_us, sum_vs = sum_us + gus, sum_vs + gvs
                a02, a12_, a22, gs, gx0, gy0, gus, gvs, gu0, gv0 = _axis_backward(
                    b02, b12, b22, s2, fx, fy, u, v_, us, vs, iz, jx2, jy2, h2, s_xx, s_xy, s_yy, l0, l1, l2, ga0
                )
                gs2 += gs
                gjx, gjy, gu, gv = gjx + gx0, gjy + gy0, gu + gu0, gv + gv0
                sum_us, sum_vs = sum_us + gus, sum_vs + gvs
                gfx, gfy = gfx + gjx * ifx, gfy + gjy * ify
                if solid:
                    gu, gv = gu + sum_us, gv + sum_vs
                else:
                    gu += tl.where(us == u, sum_us, 0.0)
                    gv += tl.where(vs == v_, sum_vs, 0.0)
                gz -= (gjx + gjy + gu * u + gv * v_) * iz
                gx, gy = gu * iz, gv * iz
                gm0 += w00 * gx + w10 * gy + w20 * gz
                gm1 += w01 * gx + w11 * gy + w21 * gz
                gm2 += w02 * gx + w12 * gy + w22 * gz
                go += a9
                d00 += w00 * a00 + w10 * a10_ + w20 * a20
                d01 += w00 * a01 + w10 * a11_ + w20 * a21
                d02 += w00 * a02 + w10 * a12_ + w20 * a22
                d10 += w01 * a00 + w11 * a10_ + w21 * a20
                d11 += w01 * a01 + w11 * a11_ + w21 * a21
                d12 += w01 * a02 + w11 * a12_ + w21 * a22
                d20 += w02 * a00 + w12 * a10_ + w22 * a20
                d21 += w02 * a01 + w12 * a11_ + w22 * a21
                d22 += w02 * a02 + w12 * a12_ + w22 * a22
                # colour: no gradient where it was clamped at 0
                tint = records + slot * _RECORD + 13
                a13 = tl.where(tl.load(tint, mask=act, other=0.0) > 0, a13, 0.0)
                a14 = tl.where(tl.load(tint + 1, mask=act, other=0.0) > 0, a14, 0.0)
                a15 = tl.where(tl.load(tint + 2, mask=act, other=0.0) > 0, a15, 0.0)
                c0, c1, c2 = w00 * x + w10 * y + w20 * z, w01 * x + w11 * y + w21 * z, w02 * x + w12 * y + w22 * z
                far = 1.0 / tl.sqrt(tl.where(act, c0 * c0 + c1 * c1 + c2 * c2, 1.0))
                c0, c1, c2 = c0 * far, c1 * far, c2 * far
                p, grad = sh + coefficients, grad_sh + coefficients
                o0, o1, o2 = shade_backward(p, grad, a13, c0, c1, c2, act, degree)
                f0, f1, f2 = shade_backward(p + 1, grad + 1, a14, c0, c1, c2, act, degree)
                o0, o1, o2 = o0 + f0, o1 + f1, o2 + f2
                f0, f1, f2 = shade_backward(p + 2, grad + 2, a15, c0, c1, c2, act, degree)
                o0, o1, o2 = o0 + f0, o1 + f1, o2 + f2
                if degree > 0:
                    along = o0 * c0 + o1 * c1 + o2 * c2
                    o0, o1, o2 = (o0 - c0 * along) * far, (o1 - c1 * along) * far, (o2 - c2 * along) * far
                    gm0, gm1, gm2 = gm0 + o0, gm1 + o1, gm2 + o2
                if cameras:
                    # pose: through the mean, the axes (pose rotation times Gaussian rotation), and the camera's centre
                    to = grad_cameras + ((tl.program_id(0) * scenes).to(tl.int64) * views + view) * _CAMERA
                    tl.store(to, tl.sum(gx * m0 + a00 * r00 + a01 * r01 + a02 * r02 + t0 * o0, 0))
                    tl.store(to + 1, tl.sum(gx * m1 + a00 * r10 + a01 * r11 + a02 * r12 + t0 * o1, 0))
                    tl.store(to + 2, tl.sum(gx * m2 + a00 * r20 + a01 * r21 + a02 * r22 + t0 * o2, 0))
                    tl.store(to + 3, tl.sum(gx + w00 * o0 + w01 * o1 + w02 * o2, 0))
                    tl.store(to + 4, tl.sum(gy * m0 + a10_ * r00 + a11_ * r01 + a12_ * r02 + t1 * o0, 0))
                    tl.store(to + 5, tl.sum(gy * m1 + a10_ * r10 + a11_ * r11 + a12_ * r12 + t1 * o1, 0))
                    tl.store(to + 6, tl.sum(gy * m2 + a10_ * r20 + a11_ * r21 + a12_ * r22 + t1 * o2, 0))
                    tl.store(to + 7, tl.sum(gy + w10 * o0 + w11 * o1 + w12 * o2, 0))
                    tl.store(to + 8, tl.sum(gz * m0 + a20 * r00 + a21 * r01 + a22 * r02 + t2 * o0, 0))
                    tl.store(to + 9, tl.sum(gz * m1 + a20 * r10 + a21 * r11 + a22 * r12 + t2 * o1, 0))
                    tl.store(to + 10, tl.sum(gz * m2 + a20 * r20 + a21 * r21 + a22 * r22 + t2 * o2, 0))
                    tl.store(to + 11, tl.sum(gz + w20 * o0 + w21 * o1 + w22 * o2, 0))
                    tl.store(to + 16, tl.sum(gfx, 0))
                    tl.store(to + 18, tl.sum(a0, 0))
                    tl.store(to + 20, tl.sum(gfy, 0))
                    tl.store(to + 21, tl.sum(a1, 0))
                tl.debug_barrier()  # the next view adds to the coefficients' gradients
            v += 1
        current += 1
    # rotation matrix -> quaternion -> unnormalised quaternion
    gqw = 2.0 * (qx * (d21 - d12) + qy * (d02 - d20) + qz * (d10 - d01))
    gqx = 2.0 * (qy * (d01 + d10) + qz * (d02 + d20) - 2.0 * qx * (d11 + d22) + qw * (d21 - d12))
    gqy = 2.0 * (qx * (d01 + d10) + qz * (d12 + d21) - 2.0 * qy * (d00 + d22) + qw * (d02 - d20))
    gqz = 2.0 * (qx * (d02 + d20) + qy * (d12 + d21) - 2.0 * qz * (d00 + d11) + qw * (d10 - d01))
    radial = gqw * qw + gqx * qx + gqy * qy + gqz * qz
    _add(grad_means + 3 * i, gm0, there)
    _add(grad_means + 3 * i + 1, gm1, there)
    _add(grad_means + 3 * i + 2, gm2, there)
    _add(grad_scales + 3 * i, gs0, there)
    _add(grad_scales + 3 * i + 1, gs1, there)
    _add(grad_scales + 3 * i + 2, gs2, there)
    _add(grad_quats + 4 * i, (gqw - qw * radial) * norm, there)
    _add(grad_quats + 4 * i + 1, (gqx - qx * radial) * norm, there)
    _add(grad_quats + 4 * i + 2, (gqy - qy * radial) * norm, there)
    _add(grad_quats + 4 * i + 3, (gqz - qz * radial) * norm, there)
    opacity = tl.load(opacities + i)
    _add(grad_opacities + i, tl.where(opacity > 0, go / tl.where(opacity > 0, opacity, 1.0), 0.0), there)


@triton.jit
def _add(to, value, there):
    tl.store(to, tl.load(to, mask=there, other=0.0) + value, mask=there)
