"""Compiled projection of Gaussians into one view, forward and backward (formulas: vg2gt/rendering/projection.py).

Everything is computed in float64, whatever the dtype of the arrays.
"""

# The kernels are written for the compiler: scalars instead of small arrays.

from __future__ import annotations

import math
from typing import Any

import numpy as np

from vg2gt.io.compiled import kernel
from vg2gt.rendering.options import ALPHA_MIN, JACOBIAN_CLAMP

FAST: Any = {"contract", "nsz", "arcp"}  # nothing that assumes finite values
SUMMED = 128  # Gaussians whose gradient rows are summed before they are chained on
BLOCK = 2048  # Gaussians a work item; fixed, because camera gradients are summed block by block


@kernel(error_model="numpy", nogil=True, inline="always")
def _rotation(w, x, y, z):
    """Rotation matrix of a unit quaternion, row by row."""
    return (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip


@kernel(fastmath=FAST, error_model="numpy", nogil=True)
def project_block(
    block, means, quats, scales, opacities, pose, intrinsics, height, width, lowpass, near, solid, records, boxes
):
    """Writes the records and pixel boxes (x0, x1, y0, y1; ends excluded; empty if unseen) of a block of Gaussians."""
    w00, w01, w02, t0 = pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]
    w10, w11, w12, t1 = pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]
    w20, w21, w22, t2 = pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    x_limit, y_limit = JACOBIAN_CLAMP * 0.5 * width / fx, JACOBIAN_CLAMP * 0.5 * height / fy
    for i in range(block * BLOCK, min((block + 1) * BLOCK, len(means))):
        boxes[i, 0] = boxes[i, 1] = boxes[i, 2] = boxes[i, 3] = 0
        mx, my, mz = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
        z = w20 * mx + w21 * my + w22 * mz + t2
        if not z > near:
            continue
        u = (w00 * mx + w01 * my + w02 * mz + t0) / z
        v = (w10 * mx + w11 * my + w12 * mz + t1) / z
        qw, qx = np.float64(quats[i, 0]), np.float64(quats[i, 1])
        qy, qz = np.float64(quats[i, 2]), np.float64(quats[i, 3])
        norm = 1 / math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
        r = _rotation(qw * norm, qx * norm, qy * norm, qz * norm)
        us, vs = u, v
        if not solid:
            us, vs = min(max(u, -x_limit), x_limit), min(max(v, -y_limit), y_limit)
        xx, xy, yy = lowpass, 0.0, lowpass
        a0 = l0 = l1 = l2 = 0.0
        for k in range(3):
            if k == 0:
                e0, e1, e2 = r[0], r[3], r[6]
            elif k == 1:
                e0, e1, e2 = r[1], r[4], r[7]
            else:
                e0, e1, e2 = r[2], r[5], r[8]
            b0 = w00 * e0 + w01 * e1 + w02 * e2
            b1 = w10 * e0 + w11 * e1 + w12 * e2
            b2 = w20 * e0 + w21 * e1 + w22 * e2
            scale = np.float64(scales[i, k])
            jx, jy = scale * fx * (b0 - us * b2) / z, scale * fy * (b1 - vs * b2) / z
            xx += jx * jx
            xy += jx * jy
            yy += jy * jy
            h = (b0 * u + b1 * v + b2) / scale
            a0 += h * h
            l0 += b0 * h / scale
            l1 += b1 * h / scale
            l2 += b2 * h / scale
        det = xx * yy - xy * xy
        opacity = np.float64(opacities[i])
        if not (det > 0 and opacity > ALPHA_MIN):
            continue
        qa, qb, qc = yy / det, -xy / det, xx / det
        q0 = q1 = eps = 0.0
        if solid:
            q0, q1, eps = l0 / (fx * a0), l1 / (fy * a0), 1 / (z * z * a0)
        cutoff = 2 * math.log(opacity / ALPHA_MIN)
        k = 1 - cutoff * eps
        box_xx, box_xy, box_yy = k * qa - cutoff * q0 * q0, k * qb - cutoff * q0 * q1, k * qc - cutoff * q1 * q1
        box_det = box_xx * box_yy - box_xy * box_xy
        if not (k > 0 and box_xx > 0 and box_det > 0):  # the region of alpha >= 1/255 reaches the camera plane
            continue
        inv_xx, inv_xy, inv_yy = box_yy / box_det, -box_xy / box_det, box_xx / box_det
        dx, dy = cutoff * (inv_xx * q0 + inv_xy * q1), cutoff * (inv_xy * q0 + inv_yy * q1)
        radius2 = cutoff * (1 + q0 * dx + q1 * dy)
        uc, vc = fx * u + cx, fy * v + cy
        half_x, half_y = math.sqrt(inv_xx * radius2), math.sqrt(inv_yy * radius2)
        left, right = max(uc + dx - half_x, -1.0), min(uc + dx + half_x, width + 0.0)
        top, bottom = max(vc + dy - half_y, -1.0), min(vc + dy + half_y, height + 0.0)
        x0, x1 = max(np.int64(math.ceil(left)), 0), min(np.int64(math.floor(right)) + 1, width)
        y0, y1 = max(np.int64(math.ceil(top)), 0), min(np.int64(math.floor(bottom)) + 1, height)
        if not (left <= right and top <= bottom and x0 < x1 and y0 < y1):
            continue
        boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = x0, x1, y0, y1
        length = -1 / math.sqrt(l0 * l0 + l1 * l1 + l2 * l2)
        g = records[i]
        g[0], g[1], g[2], g[3], g[4], g[5], g[6], g[7] = uc, vc, qa, qb, qc, q0, q1, z
        g[8], g[9], g[10], g[11], g[12], g[13], g[14] = a0, eps, opacity, cutoff, l0 * length, l1 * length, l2 * length


@kernel(fastmath=FAST, error_model="numpy", nogil=True, inline="always")
def _whiten(b0, b1, b2, scale, fx, fy, u, v, us, vs, iz):
    """One axis of a Gaussian: its Jacobian row pair, and its component of the ray in units of the axis's length."""
    return scale * fx * (b0 - us * b2) * iz, scale * fy * (b1 - vs * b2) * iz, (b0 * u + b1 * v + b2) / scale


@kernel(fastmath=FAST, error_model="numpy", nogil=True, inline="always")
def _axis_gradient(b0, b1, b2, scale, fx, fy, u, v, us, vs, iz, jx, jy, h, s_xx, s_xy, s_yy, gl0, gl1, gl2, ga0):
    """Gradients through one axis: camera-frame axis (3), scale, the Jacobian's products (2) and slopes (2), u, v."""
    inverse = 1 / scale
    gjx, gjy = 2 * (s_xx * jx + s_xy * jy), 2 * (s_xy * jx + s_yy * jy)
    px, py = gjx * scale * fx * iz, gjy * scale * fy * iz
    w = h * inverse
    gw = gl0 * b0 + gl1 * b1 + gl2 * b2
    gh = (gw * inverse + 2 * h * ga0) * inverse
    g0, g1, g2 = px + w * gl0 + gh * u, py + w * gl1 + gh * v, w * gl2 + gh - px * us - py * vs
    gjx *= jx
    gjy *= jy
    return g0, g1, g2, (gjx + gjy - gw * w) * inverse - gh * h, gjx, gjy, -px * b2, -py * b2, gh * b0, gh * b1


@kernel(error_model="numpy", nogil=True)
def _sum_rows(begin, end, boxes, counts, offsets, places, rows, totals):
    """Sums the gradient rows of some Gaussians, ahead of their use so that the cache misses overlap."""
    for i in range(begin, end):
        total = totals[i - begin]
        for j in range(16):
            total[j] = 0.0
        if boxes[i, 1] <= boxes[i, 0]:
            continue
        for place in range(offsets[i], offsets[i] + counts[i]):
            row = rows[places[place]]
            for j in range(16):
                total[j] += row[j]


@kernel(fastmath=FAST, error_model="numpy", nogil=True)
def project_backward_block(
    block, means, quats, scales, opacities, pose, intrinsics, height, width, lowpass, solid,
    boxes, counts, offsets, places, rows, color_view,
    grad_means, grad_quats, grad_scales, grad_opacities, grad_colors, grad_cameras,
):  # fmt: skip
    """Sums every Gaussian's gradient rows, in order, and chains them to the 3D parameters (added to) and the camera.

    ``grad_cameras[block]`` receives the gradient of the pose's upper three rows and of fx, fy, cx, cy.
    """
    w00, w01, w02, t0 = pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]
    w10, w11, w12, t1 = pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]
    w20, w21, w22, t2 = pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]
    fx, fy = np.float64(intrinsics[0, 0]), np.float64(intrinsics[1, 1])
    ifx, ify = 1 / fx, 1 / fy
    x_limit, y_limit = JACOBIAN_CLAMP * 0.5 * width / fx, JACOBIAN_CLAMP * 0.5 * height / fy
    camera, totals = np.zeros(16, np.float64), np.empty((SUMMED, 16), np.float64)
    begin, end = block * BLOCK, min((block + 1) * BLOCK, len(means))
    for i in range(begin, end):
        if (i - begin) % SUMMED == 0:
            _sum_rows(i, min(i + SUMMED, end), boxes, counts, offsets, places, rows, totals)
        if boxes[i, 1] <= boxes[i, 0]:
            continue
        row = totals[(i - begin) % SUMMED]
        used = False
        for j in range(16):
            used |= row[j] != 0.0
        if not used:
            continue
        mx, my, mz = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
        z = w20 * mx + w21 * my + w22 * mz + t2
        iz = 1 / z
        u = (w00 * mx + w01 * my + w02 * mz + t0) * iz
        v = (w10 * mx + w11 * my + w12 * mz + t1) * iz
        us, vs = u, v
        if not solid:
            us, vs = min(max(u, -x_limit), x_limit), min(max(v, -y_limit), y_limit)
        qw, qx = np.float64(quats[i, 0]), np.float64(quats[i, 1])
        qy, qz = np.float64(quats[i, 2]), np.float64(quats[i, 3])
        norm = 1 / math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
        qw, qx, qy, qz = qw * norm, qx * norm, qy * norm, qz * norm
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = _rotation(qw, qx, qy, qz)
        s0, s1, s2 = np.float64(scales[i, 0]), np.float64(scales[i, 1]), np.float64(scales[i, 2])
        b00, b01, b02 = (
            w00 * r00 + w01 * r10 + w02 * r20, w00 * r01 + w01 * r11 + w02 * r21, w00 * r02 + w01 * r12 + w02 * r22,
        )  # fmt: skip
        b10, b11, b12 = (
            w10 * r00 + w11 * r10 + w12 * r20, w10 * r01 + w11 * r11 + w12 * r21, w10 * r02 + w11 * r12 + w12 * r22,
        )  # fmt: skip
        b20, b21, b22 = (
            w20 * r00 + w21 * r10 + w22 * r20, w20 * r01 + w21 * r11 + w22 * r21, w20 * r02 + w21 * r12 + w22 * r22,
        )  # fmt: skip
        jx0, jy0, h0 = _whiten(b00, b10, b20, s0, fx, fy, u, v, us, vs, iz)
        jx1, jy1, h1 = _whiten(b01, b11, b21, s1, fx, fy, u, v, us, vs, iz)
        jx2, jy2, h2 = _whiten(b02, b12, b22, s2, fx, fy, u, v, us, vs, iz)
        xx, yy = lowpass + jx0 * jx0 + jx1 * jx1 + jx2 * jx2, lowpass + jy0 * jy0 + jy1 * jy1 + jy2 * jy2
        xy = jx0 * jy0 + jx1 * jy1 + jx2 * jy2
        a0 = h0 * h0 + h1 * h1 + h2 * h2
        e0, e1, e2 = h0 / s0, h1 / s1, h2 / s2
        l0, l1, l2 = b00 * e0 + b01 * e1 + b02 * e2, b10 * e0 + b11 * e1 + b12 * e2, b20 * e0 + b21 * e1 + b22 * e2
        idet = 1 / (xx * yy - xy * xy)
        qa, qb, qc = yy * idet, -xy * idet, xx * idet
        # conic -> screen covariance: -Q dQ Q
        ga, gb, gc = row[2], 0.5 * row[3], row[4]
        m00, m01, m10, m11 = qa * ga + qb * gb, qa * gb + qb * gc, qb * ga + qc * gb, qb * gb + qc * gc
        s_xx, s_xy, s_yy = -(m00 * qa + m01 * qb), -(m00 * qb + m01 * qc), -(m10 * qb + m11 * qc)
        gu, gv, gz = fx * row[0], fy * row[1], row[7]
        gfx, gfy = u * row[0], v * row[1]
        gl0 = gl1 = gl2 = ga0 = 0.0
        if solid:
            ia0 = 1 / a0
            gl0, gl1 = row[5] * ifx * ia0, row[6] * ify * ia0
            ga0 = row[8] - (gl0 * l0 + gl1 * l1) * ia0
            gfx -= gl0 * l0 * ifx
            gfy -= gl1 * l1 * ify
        length = 1 / math.sqrt(l0 * l0 + l1 * l1 + l2 * l2)
        n0, n1, n2 = -l0 * length, -l1 * length, -l2 * length
        along = row[13] * n0 + row[14] * n1 + row[15] * n2
        gl0 -= (row[13] - n0 * along) * length
        gl1 -= (row[14] - n1 * along) * length
        gl2 -= (row[15] - n2 * along) * length
        a00, a10, a20, gs0, gx0, gy0, gus0, gvs0, gu0, gv0 = _axis_gradient(
            b00, b10, b20, s0, fx, fy, u, v, us, vs, iz, jx0, jy0, h0, s_xx, s_xy, s_yy, gl0, gl1, gl2, ga0
        )
        a01, a11, a21, gs1, gx1, gy1, gus1, gvs1, gu1, gv1 = _axis_gradient(
            b01, b11, b21, s1, fx, fy, u, v, us, vs, iz, jx1, jy1, h1, s_xx, s_xy, s_yy, gl0, gl1, gl2, ga0
        )
        a02, a12, a22, gs2, gx2, gy2, gus2, gvs2, gu2, gv2 = _axis_gradient(
            b02, b12, b22, s2, fx, fy, u, v, us, vs, iz, jx2, jy2, h2, s_xx, s_xy, s_yy, gl0, gl1, gl2, ga0
        )
        gjx, gjy = gx0 + gx1 + gx2, gy0 + gy1 + gy2
        gfx += gjx * ifx
        gfy += gjy * ify
        gu += gu0 + gu1 + gu2
        gv += gv0 + gv1 + gv2
        if solid or abs(u) < x_limit:
            gu += gus0 + gus1 + gus2
        if solid or abs(v) < y_limit:
            gv += gvs0 + gvs1 + gvs2
        gz -= (gjx + gjy + gu * u + gv * v) * iz
        gx, gy = gu * iz, gv * iz
        grad_means[i, 0] += w00 * gx + w10 * gy + w20 * gz
        grad_means[i, 1] += w01 * gx + w11 * gy + w21 * gz
        grad_means[i, 2] += w02 * gx + w12 * gy + w22 * gz
        grad_scales[i, 0] += gs0
        grad_scales[i, 1] += gs1
        grad_scales[i, 2] += gs2
        grad_opacities[i] += row[9]
        for k in range(3):
            grad_colors[color_view, i, k] += row[10 + k]
        # pose: through the mean, and through the axes (pose rotation times Gaussian rotation)
        camera[0] += gx * mx + a00 * r00 + a01 * r01 + a02 * r02
        camera[1] += gx * my + a00 * r10 + a01 * r11 + a02 * r12
        camera[2] += gx * mz + a00 * r20 + a01 * r21 + a02 * r22
        camera[3] += gx
        camera[4] += gy * mx + a10 * r00 + a11 * r01 + a12 * r02
        camera[5] += gy * my + a10 * r10 + a11 * r11 + a12 * r12
        camera[6] += gy * mz + a10 * r20 + a11 * r21 + a12 * r22
        camera[7] += gy
        camera[8] += gz * mx + a20 * r00 + a21 * r01 + a22 * r02
        camera[9] += gz * my + a20 * r10 + a21 * r11 + a22 * r12
        camera[10] += gz * mz + a20 * r20 + a21 * r21 + a22 * r22
        camera[11] += gz
        camera[12] += gfx
        camera[13] += gfy
        camera[14] += row[0]
        camera[15] += row[1]
        d00, d01, d02 = (
            w00 * a00 + w10 * a10 + w20 * a20, w00 * a01 + w10 * a11 + w20 * a21, w00 * a02 + w10 * a12 + w20 * a22,
        )  # fmt: skip
        d10, d11, d12 = (
            w01 * a00 + w11 * a10 + w21 * a20, w01 * a01 + w11 * a11 + w21 * a21, w01 * a02 + w11 * a12 + w21 * a22,
        )  # fmt: skip
        d20, d21, d22 = (
            w02 * a00 + w12 * a10 + w22 * a20, w02 * a01 + w12 * a11 + w22 * a21, w02 * a02 + w12 * a12 + w22 * a22,
        )  # fmt: skip
        gqw = 2 * (qx * (d21 - d12) + qy * (d02 - d20) + qz * (d10 - d01))
        gqx = 2 * (qy * (d01 + d10) + qz * (d02 + d20) - 2 * qx * (d11 + d22) + qw * (d21 - d12))
        gqy = 2 * (qx * (d01 + d10) + qz * (d12 + d21) - 2 * qy * (d00 + d22) + qw * (d02 - d20))
        gqz = 2 * (qx * (d02 + d20) + qy * (d12 + d21) - 2 * qz * (d00 + d11) + qw * (d10 - d01))
        radial = gqw * qw + gqx * qx + gqy * qy + gqz * qz
        grad_quats[i, 0] += (gqw - qw * radial) * norm
        grad_quats[i, 1] += (gqx - qx * radial) * norm
        grad_quats[i, 2] += (gqy - qy * radial) * norm
        grad_quats[i, 3] += (gqz - qz * radial) * norm
    for j in range(16):
        grad_cameras[block, j] = camera[j]
