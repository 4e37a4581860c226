"""Compiled backward pass of the projection, in float64: chains a view's screen gradients to Gaussians and camera.

Parameters and summed gradient rows are stored as a structure of arrays, so that the chain is one vector loop.
"""

# The kernels are written for the compiler: scalars instead of small arrays.

from __future__ import annotations

import math

import numpy as np

from vg2gt.kernels.compiled import kernel, kernel_part
from vg2gt.rendering.constants import COMPENSATION_FLOOR, FAST, JACOBIAN_CLAMP
from vg2gt.rendering.cpu.projection import BLOCK, rotation, whiten

CHUNK = 64  # Gaussians processed at a time
FIELDS = 52  # arrays of CHUNK values that the chain reads and writes
MEAN, _QUAT, SCALE, ROW = (np.uintp(j * CHUNK) for j in (0, 3, 7, 10))
_GRAD_MEAN, _GRAD_QUAT, _GRAD_SCALE, CAMERA = (np.uintp(j * CHUNK) for j in (26, 29, 33, 36))
_VECTOR = 8  # the chain's loop length is a multiple of this, so that no scalar remainder loop is left


@kernel_part(fastmath=FAST, error_model="numpy", forceinline=True)
def _axis_gradient(b0, b1, b2, scale, fx, fy, u, v, us, vs, iz, jx, jy, h, s_xx, s_xy, s_yy, gl0, gl1, gl2, ga0):
    """Returns gradients of one axis: camera-frame axis (3), scale, Jacobian products (2) and slopes (2), u, v."""
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


@kernel_part(fastmath=FAST, error_model="numpy")
def _gather(begin, end, means, quats, scales, counts, offsets, rows, total, work, indices):
    """Sums the gradient rows per Gaussian, in order; packs Gaussians with nonzero sums, and returns their number."""
    found = 0
    for i in range(begin, end):
        if counts[i] == 0:
            continue
        for j in range(16):
            total[j] = 0.0
        for place in range(offsets[i], offsets[i] + counts[i]):
            for j in range(16):
                total[j] += rows[place, j]
        used = False
        for j in range(16):
            used |= total[j] != 0.0
        if not used:
            continue
        c = np.uintp(found)
        for j in range(16):
            work[ROW + np.uintp(j * CHUNK) + c] = total[j]
        for j in range(3):
            work[MEAN + np.uintp(j * CHUNK) + c] = means[i, j]
            work[SCALE + np.uintp(j * CHUNK) + c] = scales[i, j]
        for j in range(4):
            work[_QUAT + np.uintp(j * CHUNK) + c] = quats[i, j]
        indices[found] = i
        found += 1
    return found


@kernel_part(fastmath=FAST, error_model="numpy")
def _compensate(work, indices, count, records, lowpass):
    """Chains the compensated opacity's gradient to the opacity and, as rho^2 = det(I - lowpass Q), to the conic Q."""
    for found in range(count):
        c, g = np.uintp(found), records[indices[found]]
        sa, sb, sc = 1 - lowpass * g[2], lowpass * g[3], 1 - lowpass * g[4]
        share = max(sa * sc - sb * sb, COMPENSATION_FLOOR)
        gradient = work[ROW + 9 * CHUNK + c]
        to_share = lowpass * gradient * g[10] / share
        work[ROW + 2 * CHUNK + c] -= 0.5 * to_share * sc
        work[ROW + 3 * CHUNK + c] -= to_share * sb
        work[ROW + 4 * CHUNK + c] -= 0.5 * to_share * sa
        work[ROW + 9 * CHUNK + c] = gradient * math.sqrt(share)


@kernel_part(fastmath=FAST, error_model="numpy")
def _chain(work, count, pose, fx, fy, x_limit, y_limit, lowpass, solid):
    """Writes gradients of means, quaternions, scales and camera, per Gaussian; ``solid`` is 1 or 0."""
    w00, w01, w02, t0 = pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]
    w10, w11, w12, t1 = pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]
    w20, w21, w22, t2 = pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]
    ifx, ify = 1 / fx, 1 / fy
    for lane in range(-(-count // _VECTOR) * _VECTOR):
        c = np.uintp(lane)
        mx, my, mz = work[MEAN + c], work[MEAN + CHUNK + c], work[MEAN + 2 * CHUNK + c]
        row0, row1, row2 = work[ROW + c], work[ROW + CHUNK + c], work[ROW + 2 * CHUNK + c]
        row3, row4, row5 = work[ROW + 3 * CHUNK + c], work[ROW + 4 * CHUNK + c], work[ROW + 5 * CHUNK + c]
        row6, row7, row8 = work[ROW + 6 * CHUNK + c], work[ROW + 7 * CHUNK + c], work[ROW + 8 * CHUNK + c]
        row13, row14, row15 = work[ROW + 13 * CHUNK + c], work[ROW + 14 * CHUNK + c], work[ROW + 15 * CHUNK + c]
        z = w20 * mx + w21 * my + w22 * mz + t2
        iz = 1 / z
        u = (w00 * mx + w01 * my + w02 * mz + t0) * iz
        v = (w10 * mx + w11 * my + w12 * mz + t1) * iz
        us, vs = min(max(u, -x_limit), x_limit), min(max(v, -y_limit), y_limit)
        qw, qx, qy, qz = (
            work[_QUAT + c],
            work[_QUAT + CHUNK + c],
            work[_QUAT + 2 * CHUNK + c],
            work[_QUAT + 3 * CHUNK + c],
        )
        norm = 1 / math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
        qw, qx, qy, qz = qw * norm, qx * norm, qy * norm, qz * norm
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation(qw, qx, qy, qz)
        s0, s1, s2 = work[SCALE + c], work[SCALE + CHUNK + c], work[SCALE + 2 * CHUNK + c]
        b00, b01, b02 = (
            w00 * r00 + w01 * r10 + w02 * r20, w00 * r01 + w01 * r11 + w02 * r21, w00 * r02 + w01 * r12 + w02 * r22,
        )  # fmt: skip
        b10, b11, b12 = (
            w10 * r00 + w11 * r10 + w12 * r20, w10 * r01 + w11 * r11 + w12 * r21, w10 * r02 + w11 * r12 + w12 * r22,
        )  # fmt: skip
        b20, b21, b22 = (
            w20 * r00 + w21 * r10 + w22 * r20, w20 * r01 + w21 * r11 + w22 * r21, w20 * r02 + w21 * r12 + w22 * r22,
        )  # fmt: skip
        jx0, jy0, h0 = whiten(b00, b10, b20, s0, fx, fy, u, v, us, vs, iz)
        jx1, jy1, h1 = whiten(b01, b11, b21, s1, fx, fy, u, v, us, vs, iz)
        jx2, jy2, h2 = whiten(b02, b12, b22, s2, fx, fy, u, v, us, vs, iz)
        xx, yy = lowpass + jx0 * jx0 + jx1 * jx1 + jx2 * jx2, lowpass + jy0 * jy0 + jy1 * jy1 + jy2 * jy2
        xy = jx0 * jy0 + jx1 * jy1 + jx2 * jy2
        a0 = h0 * h0 + h1 * h1 + h2 * h2
        e0, e1, e2 = h0 / s0, h1 / s1, h2 / s2
        l0, l1, l2 = b00 * e0 + b01 * e1 + b02 * e2, b10 * e0 + b11 * e1 + b12 * e2, b20 * e0 + b21 * e1 + b22 * e2
        idet = 1 / (xx * yy - xy * xy)
        qa, qb, qc = yy * idet, -xy * idet, xx * idet
        # conic -> screen covariance: -Q dQ Q
        ga, gb, gc = row2, 0.5 * row3, row4
        m00, m01, m10, m11 = qa * ga + qb * gb, qa * gb + qb * gc, qb * ga + qc * gb, qb * gb + qc * gc
        s_xx, s_xy, s_yy = -(m00 * qa + m01 * qb), -(m00 * qb + m01 * qc), -(m10 * qb + m11 * qc)
        gu, gv, gz = fx * row0, fy * row1, row7
        gfx, gfy = u * row0, v * row1
        # tilt and a0: only solids depend on them
        ia0 = solid / a0
        gl0, gl1, gl2 = row5 * ifx * ia0, row6 * ify * ia0, 0.0
        ga0 = solid * row8 - (gl0 * l0 + gl1 * l1) * ia0
        gfx -= gl0 * l0 * ifx
        gfy -= gl1 * l1 * ify
        # normal -L m / |L m|
        length = 1 / math.sqrt(l0 * l0 + l1 * l1 + l2 * l2)
        n0, n1, n2 = -l0 * length, -l1 * length, -l2 * length
        along = row13 * n0 + row14 * n1 + row15 * n2
        gl0 -= (row13 - n0 * along) * length
        gl1 -= (row14 - n1 * along) * length
        gl2 -= (row15 - n2 * along) * length
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
        gu += (gus0 + gus1 + gus2) if abs(u) < x_limit else 0.0
        gv += (gvs0 + gvs1 + gvs2) if abs(v) < y_limit else 0.0
        gz -= (gjx + gjy + gu * u + gv * v) * iz
        gx, gy = gu * iz, gv * iz
        work[_GRAD_MEAN + c] = w00 * gx + w10 * gy + w20 * gz
        work[_GRAD_MEAN + CHUNK + c] = w01 * gx + w11 * gy + w21 * gz
        work[_GRAD_MEAN + 2 * CHUNK + c] = w02 * gx + w12 * gy + w22 * gz
        work[_GRAD_SCALE + c], work[_GRAD_SCALE + CHUNK + c], work[_GRAD_SCALE + 2 * CHUNK + c] = gs0, gs1, gs2
        # pose: through the mean, and through the axes (pose rotation times Gaussian rotation)
        work[CAMERA + c] = gx * mx + a00 * r00 + a01 * r01 + a02 * r02
        work[CAMERA + CHUNK + c] = gx * my + a00 * r10 + a01 * r11 + a02 * r12
        work[CAMERA + 2 * CHUNK + c] = gx * mz + a00 * r20 + a01 * r21 + a02 * r22
        work[CAMERA + 3 * CHUNK + c] = gx
        work[CAMERA + 4 * CHUNK + c] = gy * mx + a10 * r00 + a11 * r01 + a12 * r02
        work[CAMERA + 5 * CHUNK + c] = gy * my + a10 * r10 + a11 * r11 + a12 * r12
        work[CAMERA + 6 * CHUNK + c] = gy * mz + a10 * r20 + a11 * r21 + a12 * r22
        work[CAMERA + 7 * CHUNK + c] = gy
        work[CAMERA + 8 * CHUNK + c] = gz * mx + a20 * r00 + a21 * r01 + a22 * r02
        work[CAMERA + 9 * CHUNK + c] = gz * my + a20 * r10 + a21 * r11 + a22 * r12
        work[CAMERA + 10 * CHUNK + c] = gz * mz + a20 * r20 + a21 * r21 + a22 * r22
        work[CAMERA + 11 * CHUNK + c] = gz
        work[CAMERA + 12 * CHUNK + c] = gfx
        work[CAMERA + 13 * CHUNK + c] = gfy
        work[CAMERA + 14 * CHUNK + c] = row0
        work[CAMERA + 15 * CHUNK + c] = row1
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
        work[_GRAD_QUAT + c] = (gqw - qw * radial) * norm
        work[_GRAD_QUAT + CHUNK + c] = (gqx - qx * radial) * norm
        work[_GRAD_QUAT + 2 * CHUNK + c] = (gqy - qy * radial) * norm
        work[_GRAD_QUAT + 3 * CHUNK + c] = (gqz - qz * radial) * norm


@kernel_part(fastmath=FAST, error_model="numpy")
def _scatter(
    work, indices, count, color_view, grad_means, grad_quats, grad_scales, grad_opacities, grad_colors, camera
):
    """Adds the chained gradients to those of the Gaussians and, in the Gaussians' order, of the camera."""
    for found in range(count):
        c, i = np.uintp(found), indices[found]
        for j in range(3):
            grad_means[i, j] += work[_GRAD_MEAN + np.uintp(j * CHUNK) + c]
            grad_scales[i, j] += work[_GRAD_SCALE + np.uintp(j * CHUNK) + c]
            grad_colors[color_view, i, j] += work[ROW + np.uintp((10 + j) * CHUNK) + c]
        for j in range(4):
            grad_quats[i, j] += work[_GRAD_QUAT + np.uintp(j * CHUNK) + c]
        grad_opacities[i] += work[ROW + np.uintp(9 * CHUNK) + c]
        for j in range(16):
            camera[j] += work[CAMERA + np.uintp(j * CHUNK) + c]


@kernel(fastmath=FAST, error_model="numpy", nogil=True)
def project_backward_block(
    block, means, quats, scales, pose, intrinsics, height, width, lowpass, solid, antialiased, records,
    counts, offsets, rows, color_view, total, work, indices,
    grad_means, grad_quats, grad_scales, grad_opacities, grad_colors, grad_cameras,
):  # fmt: skip
    """Sums each Gaussian's gradient rows, in order, and chains them to the 3D parameters (accumulated) and the camera.

    ``grad_cameras[block]`` receives the gradient of the pose's upper three rows and of fx, fy, cx, cy.
    """
    fx, fy = np.float64(intrinsics[0, 0]), np.float64(intrinsics[1, 1])
    # the Jacobian of a solid is not clamped
    x_limit = math.inf if solid else JACOBIAN_CLAMP * 0.5 * width / fx
    y_limit = math.inf if solid else JACOBIAN_CLAMP * 0.5 * height / fy
    camera = grad_cameras[block]
    for j in range(16):
        camera[j] = 0.0
    end = min((block + 1) * BLOCK, len(means))
    for begin in range(block * BLOCK, end, CHUNK):
        last = min(begin + CHUNK, end)
        count = _gather(begin, last, means, quats, scales, counts, offsets, rows, total, work, indices)
        if antialiased:
            _compensate(work, indices, count, records, lowpass)
        _chain(work, count, pose, fx, fy, x_limit, y_limit, lowpass, 1.0 if solid else 0.0)
        _scatter(
            work, indices, count, color_view,
            grad_means, grad_quats, grad_scales, grad_opacities, grad_colors, camera,
        )  # fmt: skip
