"""Compiled projection of Gaussians into one view, forward and backward (formulas: vg2gt/rendering/projection.py).

Everything is computed in float64, whatever the dtype of the arrays.
"""

# The kernels are written for the compiler: scalars instead of small arrays.

from __future__ import annotations

import math

import numpy as np
from numba import njit

from vg2gt.rendering.options import ALPHA_MIN, JACOBIAN_CLAMP

BLOCK = 2048  # Gaussians a work item; fixed, because camera gradients are summed block by block


@njit(error_model="numpy", nogil=True, cache=True, inline="always")
def _rotation(w, x, y, z):
    """Rotation matrix of a unit quaternion, row by row."""
    return (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip


@njit(error_model="numpy", nogil=True, cache=True)
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


@njit(error_model="numpy", nogil=True, cache=True)
def project_backward_block(
    block, means, quats, scales, opacities, pose, intrinsics, height, width, lowpass, solid,
    boxes, counts, offsets, rows, color_view,
    grad_means, grad_quats, grad_scales, grad_opacities, grad_colors, grad_cameras,
):  # fmt: skip
    """Sums every Gaussian's gradient rows, in order, and chains them to the 3D parameters (added to) and the camera.

    ``grad_cameras[block]`` receives the gradient of the pose's upper three rows and of fx, fy, cx, cy.
    """
    fx, fy = np.float64(intrinsics[0, 0]), np.float64(intrinsics[1, 1])
    x_limit, y_limit = JACOBIAN_CLAMP * 0.5 * width / fx, JACOBIAN_CLAMP * 0.5 * height / fy
    w = np.empty((3, 4), np.float64)
    for j in range(3):
        for k in range(4):
            w[j, k] = pose[j, k]
    camera = np.zeros(16, np.float64)
    row = np.empty(16, np.float64)
    axes, grad_axes, rotation = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    grad_rotation = np.empty((3, 3))
    jx, jy, h = np.empty(3), np.empty(3), np.empty(3)
    for i in range(block * BLOCK, min((block + 1) * BLOCK, len(means))):
        if boxes[i, 1] <= boxes[i, 0]:
            continue
        for j in range(16):
            row[j] = 0.0
        used = False
        for slot in range(offsets[i], offsets[i] + counts[i]):
            for j in range(16):
                row[j] += rows[slot, j]
        for j in range(16):
            used |= row[j] != 0.0
        if not used:
            continue
        mx, my, mz = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
        z = w[2, 0] * mx + w[2, 1] * my + w[2, 2] * mz + w[2, 3]
        u = (w[0, 0] * mx + w[0, 1] * my + w[0, 2] * mz + w[0, 3]) / z
        v = (w[1, 0] * mx + w[1, 1] * my + w[1, 2] * mz + w[1, 3]) / z
        us, vs = u, v
        if not solid:
            us, vs = min(max(u, -x_limit), x_limit), min(max(v, -y_limit), y_limit)
        qw, qx = np.float64(quats[i, 0]), np.float64(quats[i, 1])
        qy, qz = np.float64(quats[i, 2]), np.float64(quats[i, 3])
        norm = 1 / math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
        qw, qx, qy, qz = qw * norm, qx * norm, qy * norm, qz * norm
        r = _rotation(qw, qx, qy, qz)
        rotation[0, 0], rotation[0, 1], rotation[0, 2] = r[0], r[1], r[2]
        rotation[1, 0], rotation[1, 1], rotation[1, 2] = r[3], r[4], r[5]
        rotation[2, 0], rotation[2, 1], rotation[2, 2] = r[6], r[7], r[8]
        xx, xy, yy = lowpass, 0.0, lowpass
        a0 = l0 = l1 = l2 = 0.0
        for k in range(3):
            for j in range(3):
                axes[j, k] = w[j, 0] * rotation[0, k] + w[j, 1] * rotation[1, k] + w[j, 2] * rotation[2, k]
            scale = np.float64(scales[i, k])
            jx[k] = scale * fx * (axes[0, k] - us * axes[2, k]) / z
            jy[k] = scale * fy * (axes[1, k] - vs * axes[2, k]) / z
            xx += jx[k] * jx[k]
            xy += jx[k] * jy[k]
            yy += jy[k] * jy[k]
            h[k] = (axes[0, k] * u + axes[1, k] * v + axes[2, k]) / scale
            a0 += h[k] * h[k]
            l0 += axes[0, k] * h[k] / scale
            l1 += axes[1, k] * h[k] / scale
            l2 += axes[2, k] * h[k] / scale
        det = xx * yy - xy * xy
        qa, qb, qc = yy / det, -xy / det, xx / det
        # conic -> screen covariance: -Q dQ Q
        ga, gb, gc = row[2], 0.5 * row[3], row[4]
        m00, m01, m10, m11 = qa * ga + qb * gb, qa * gb + qb * gc, qb * ga + qc * gb, qb * gb + qc * gc
        s_xx, s_xy, s_yy = -(m00 * qa + m01 * qb), -(m00 * qb + m01 * qc), -(m10 * qb + m11 * qc)
        gu, gv, gz, ga0 = fx * row[0], fy * row[1], row[7], row[8]
        gfx, gfy = u * row[0], v * row[1]
        gl0 = gl1 = gl2 = 0.0
        if solid:
            q0, q1 = l0 / (fx * a0), l1 / (fy * a0)
            gl0, gl1 = row[5] / (fx * a0), row[6] / (fy * a0)
            ga0 -= (row[5] * q0 + row[6] * q1) / a0
            gfx -= row[5] * q0 / fx
            gfy -= row[6] * q1 / fy
        else:
            ga0 = 0.0
        length = 1 / math.sqrt(l0 * l0 + l1 * l1 + l2 * l2)
        n0, n1, n2 = -l0 * length, -l1 * length, -l2 * length
        along = row[13] * n0 + row[14] * n1 + row[15] * n2
        gl0 -= (row[13] - n0 * along) * length
        gl1 -= (row[14] - n1 * along) * length
        gl2 -= (row[15] - n2 * along) * length
        gus = gvs = 0.0
        for k in range(3):
            scale = np.float64(scales[i, k])
            gjx = 2 * (s_xx * jx[k] + s_xy * jy[k])
            gjy = 2 * (s_xy * jx[k] + s_yy * jy[k])
            gfx += gjx * jx[k] / fx
            gfy += gjy * jy[k] / fy
            gz -= (gjx * jx[k] + gjy * jy[k]) / z
            px, py = gjx * scale * fx / z, gjy * scale * fy / z
            gus -= px * axes[2, k]
            gvs -= py * axes[2, k]
            whitened = h[k] / scale
            gw = gl0 * axes[0, k] + gl1 * axes[1, k] + gl2 * axes[2, k]
            gh = (gw / scale + 2 * h[k] * ga0) / scale
            grad_axes[0, k] = px + whitened * gl0 + gh * u
            grad_axes[1, k] = py + whitened * gl1 + gh * v
            grad_axes[2, k] = -px * us - py * vs + whitened * gl2 + gh
            gu += gh * axes[0, k]
            gv += gh * axes[1, k]
            grad_scales[i, k] += (gjx * jx[k] + gjy * jy[k] - gw * whitened) / scale - gh * h[k]
        if abs(u) < x_limit or solid:
            gu += gus
        if abs(v) < y_limit or solid:
            gv += gvs
        gz -= (gu * u + gv * v) / z
        gx, gy = gu / z, gv / z
        grad_means[i, 0] += w[0, 0] * gx + w[1, 0] * gy + w[2, 0] * gz
        grad_means[i, 1] += w[0, 1] * gx + w[1, 1] * gy + w[2, 1] * gz
        grad_means[i, 2] += w[0, 2] * gx + w[1, 2] * gy + w[2, 2] * gz
        grad_opacities[i] += row[9]
        for k in range(3):
            grad_colors[color_view, i, k] += row[10 + k]
        for j in range(3):
            for k in range(3):
                grad_rotation[j, k] = w[0, j] * grad_axes[0, k] + w[1, j] * grad_axes[1, k] + w[2, j] * grad_axes[2, k]
                camera[4 * j + k] += (
                    grad_axes[j, 0] * rotation[k, 0]
                    + grad_axes[j, 1] * rotation[k, 1]
                    + grad_axes[j, 2] * rotation[k, 2]
                )
        camera[0] += gx * mx
        camera[1] += gx * my
        camera[2] += gx * mz
        camera[3] += gx
        camera[4] += gy * mx
        camera[5] += gy * my
        camera[6] += gy * mz
        camera[7] += gy
        camera[8] += gz * mx
        camera[9] += gz * my
        camera[10] += gz * mz
        camera[11] += gz
        camera[12] += gfx
        camera[13] += gfy
        camera[14] += row[0]
        camera[15] += row[1]
        d = grad_rotation
        gqw = 2 * (qx * (d[2, 1] - d[1, 2]) + qy * (d[0, 2] - d[2, 0]) + qz * (d[1, 0] - d[0, 1]))
        gqx = 2 * (
            qy * (d[0, 1] + d[1, 0])
            + qz * (d[0, 2] + d[2, 0])
            - 2 * qx * (d[1, 1] + d[2, 2])
            + qw * (d[2, 1] - d[1, 2])
        )
        gqy = 2 * (
            qx * (d[0, 1] + d[1, 0])
            + qz * (d[1, 2] + d[2, 1])
            - 2 * qy * (d[0, 0] + d[2, 2])
            + qw * (d[0, 2] - d[2, 0])
        )
        gqz = 2 * (
            qx * (d[0, 2] + d[2, 0])
            + qy * (d[1, 2] + d[2, 1])
            - 2 * qz * (d[0, 0] + d[1, 1])
            + qw * (d[1, 0] - d[0, 1])
        )
        radial = gqw * qw + gqx * qx + gqy * qy + gqz * qz
        grad_quats[i, 0] += (gqw - qw * radial) * norm
        grad_quats[i, 1] += (gqx - qx * radial) * norm
        grad_quats[i, 2] += (gqy - qy * radial) * norm
        grad_quats[i, 3] += (gqz - qz * radial) * norm
    for j in range(16):
        grad_cameras[block, j] = camera[j]
