"""Compiled projection of Gaussians into one view, in float64 (formulas: vg2gt/rendering/projection.py)."""

# The kernels are written for the compiler: scalars instead of small arrays.

from __future__ import annotations

import math

import numpy as np

from vg2gt.kernels.compiled import kernel, kernel_part
from vg2gt.rendering.constants import ALPHA_MIN, COMPENSATION_FLOOR, FAST, JACOBIAN_CLAMP

BLOCK = 2048  # Gaussians per work item; fixed, because camera gradients are summed block by block


@kernel_part(fastmath=FAST, error_model="numpy", forceinline=True)
def rotation(w, x, y, z):
    """Rotation matrix of a unit quaternion, row by row."""
    return (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip


@kernel(fastmath=FAST, error_model="numpy", nogil=True)
def project_block(
    block, means, quats, scales, opacities, pose, intrinsics, height, width, lowpass, near, solid, antialiased,
    records, boxes,
):  # fmt: skip
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
        r = rotation(qw * norm, qx * norm, qy * norm, qz * norm)
        us, vs = u, v
        if not solid:
            us, vs = min(max(u, -x_limit), x_limit), min(max(v, -y_limit), y_limit)
        # screen covariance, inverse variance a0 along the ray, and L m, axis by axis
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
        if antialiased:
            opacity *= math.sqrt(max(((xx - lowpass) * (yy - lowpass) - xy * xy) / det, COMPENSATION_FLOOR))
        if not (det > 0 and opacity > ALPHA_MIN):
            continue
        qa, qb, qc = yy / det, -xy / det, xx / det
        q0 = q1 = eps = 0.0
        if solid:
            q0, q1, eps = l0 / (fx * a0), l1 / (fy * a0), 1 / (z * z * a0)
        cutoff = 2 * math.log(opacity / ALPHA_MIN)
        # bounding box of the pixels with alpha >= 1/255
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


@kernel_part(fastmath=FAST, error_model="numpy", forceinline=True)
def whiten(b0, b1, b2, scale, fx, fy, u, v, us, vs, iz):
    """Returns two Jacobian entries of one axis of a Gaussian, and the ray's component along it in axis lengths."""
    return scale * fx * (b0 - us * b2) * iz, scale * fy * (b1 - vs * b2) * iz, (b0 * u + b1 * v + b2) / scale
