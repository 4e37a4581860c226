"""Triton kernel that projects Gaussians into views (formulas: vg2gt/rendering/projection.py).

One lane per Gaussian. ``slot = v * total + i`` is Gaussian i in the v-th view of its own scene.
"""

# pyright: reportGeneralTypeIssues=false, reportOperatorIssue=false
# (Triton's type hints do not cover the operators and ranges used inside kernels)

from __future__ import annotations

import triton  # pyright: ignore[reportMissingImports]
import triton.language as tl  # pyright: ignore[reportMissingImports]

from vg2gt.rendering.constants import COMPENSATION_FLOOR
from vg2gt.rendering.gpu.harmonics import shade
from vg2gt.rendering.gpu.tiles import RECORD, TILE

BLOCK = 128
TINY = 1e-24  # lower bound of a quaternion's squared norm, as in F.normalize
CLAMP = 0.65  # half of constants.JACOBIAN_CLAMP
SLOTS = 1 << 30  # maximum of Gaussians times views: slots are int32, and so are sums of two (binary search)
# Tile count of a Gaussian that cannot be rendered, which shows in the total. Entries are int32 up to the end of a
# block, so there are fewer than this. The sum over all slots still fits into int64.
REFUSED = (1 << 31) - (1 << 10)

_BLOCK = tl.constexpr(BLOCK)
_RECORD = tl.constexpr(RECORD)
_TILE = tl.constexpr(TILE)
_REFUSED = tl.constexpr(REFUSED)
_ALPHA_MIN = tl.constexpr(1.0 / 255.0)
_MIN_SCALE = tl.constexpr(1e-10)
_TINY = tl.constexpr(TINY)
_CLAMP = tl.constexpr(CLAMP)
_FLOOR = tl.constexpr(COMPENSATION_FLOOR)


@triton.jit
def rotation(w, x, y, z):
    """Rotation matrix of a unit quaternion, row by row."""
    return (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip


@triton.jit
def load_pose(p):
    """Loads rotation, row by row, and translation of the pose matrix that ``p`` points to."""
    return (
        tl.load(p), tl.load(p + 1), tl.load(p + 2), tl.load(p + 4), tl.load(p + 5), tl.load(p + 6),
        tl.load(p + 8), tl.load(p + 9), tl.load(p + 10), tl.load(p + 3), tl.load(p + 7), tl.load(p + 11),
    )  # fmt: skip


@triton.jit
def along_axis(w00, w01, w02, w10, w11, w12, w20, w21, w22, e0, e1, e2, scale, fx, fy, u, v, us, vs, iz):
    """Returns one axis of a Gaussian in the camera frame, two Jacobian entries, and the whitened ray component."""
    b0, b1, b2 = w00 * e0 + w01 * e1 + w02 * e2, w10 * e0 + w11 * e1 + w12 * e2, w20 * e0 + w21 * e1 + w22 * e2
    jx, jy = scale * fx * (b0 - us * b2) * iz, scale * fy * (b1 - vs * b2) * iz
    return b0, b1, b2, jx, jy, (b0 * u + b1 * v + b2) / scale


@triton.jit
def compensation(jx0, jy0, jx1, jy1, jx2, jy2, spread, lowpass: tl.constexpr):
    """Returns the determinant without low-pass, and the square of the factor of the opacity; ``spread`` is xx + yy."""
    c01, c02, c12 = jx0 * jy1 - jx1 * jy0, jx0 * jy2 - jx2 * jy0, jx1 * jy2 - jx2 * jy1
    sharp = c01 * c01 + c02 * c02 + c12 * c12
    return sharp, tl.maximum(sharp / (sharp + lowpass * (spread - lowpass)), _FLOOR)


@triton.jit(do_not_specialize=("total", "views", "scenes", "height", "width", "across"))
def project_kernel(
    means, quats, scales, opacities, sh, batch, poses, intrinsics, background, records, rects, counts,
    total, views, scenes, height, width, across,
    near: tl.constexpr, lowpass: tl.constexpr, solid: tl.constexpr, antialiased: tl.constexpr, degree: tl.constexpr,
):  # fmt: skip
    """Writes records, first tiles and columns, and tile counts of a block of Gaussians in one view of each scene."""
    i = tl.program_id(0) * _BLOCK + tl.arange(0, _BLOCK)
    there = i < total
    i = tl.where(there, i, 0).to(tl.int64)
    scene = tl.load(batch + i)
    good = (scene >= 0) & (scene < scenes) & (scene >= tl.load(batch + tl.maximum(i - 1, 0)))
    view = tl.where(good, scene, 0) * views + tl.program_id(1)
    w00, w01, w02, w10, w11, w12, w20, w21, w22, t0, t1, t2 = load_pose(poses + view * 16)
    k = intrinsics + view * 9
    fx, cx, fy, cy = tl.load(k), tl.load(k + 2), tl.load(k + 4), tl.load(k + 5)
    m0, m1, m2 = tl.load(means + 3 * i), tl.load(means + 3 * i + 1), tl.load(means + 3 * i + 2)
    s0, s1, s2 = tl.load(scales + 3 * i), tl.load(scales + 3 * i + 1), tl.load(scales + 3 * i + 2)
    qw, qx = tl.load(quats + 4 * i), tl.load(quats + 4 * i + 1)
    qy, qz = tl.load(quats + 4 * i + 2), tl.load(quats + 4 * i + 3)
    opacity = tl.load(opacities + i)
    # x * 0 is 0 unless x is NaN or infinite
    nothing = m0 * 0 + m1 * 0 + m2 * 0 + s0 * 0 + s1 * 0 + s2 * 0 + qw * 0 + qx * 0 + qy * 0 + qz * 0 + opacity * 0
    nothing += w00 * 0 + w01 * 0 + w02 * 0 + w10 * 0 + w11 * 0 + w12 * 0 + w20 * 0 + w21 * 0 + w22 * 0
    nothing += t0 * 0 + t1 * 0 + t2 * 0 + fx * 0 + fy * 0 + cx * 0 + cy * 0
    nothing += tl.load(background) * 0 + tl.load(background + 1) * 0 + tl.load(background + 2) * 0
    coefficients = sh + i * (3 * (degree + 1) * (degree + 1))
    for c in tl.static_range(3 * (degree + 1) * (degree + 1)):
        nothing += tl.load(coefficients + c) * 0
    square = qw * qw + qx * qx + qy * qy + qz * qz
    good &= (nothing == 0) & (fx > 0) & (fy > 0) & (opacity >= 0) & (opacity <= 1)
    good &= (tl.abs(qw) + tl.abs(qx) + tl.abs(qy) + tl.abs(qz)) > 0
    good &= (s0 >= _MIN_SCALE) & (s1 >= _MIN_SCALE) & (s2 >= _MIN_SCALE)

    x, y = w00 * m0 + w01 * m1 + w02 * m2 + t0, w10 * m0 + w11 * m1 + w12 * m2 + t1
    z = w20 * m0 + w21 * m1 + w22 * m2 + t2
    seen = there & good & (z > near) & (opacity > _ALPHA_MIN)
    z = tl.where(seen, z, 1.0)
    iz = 1.0 / z
    u, v = x * iz, y * iz
    us, vs = u, v
    if not solid:
        x_limit, y_limit = (width / fx) * _CLAMP, (height / fy) * _CLAMP  # the tensor first, for Triton 3.7
        us, vs = tl.minimum(tl.maximum(u, -x_limit), x_limit), tl.minimum(tl.maximum(v, -y_limit), y_limit)
    # axes in the camera frame, screen covariance and its inverse
    norm = 1.0 / tl.sqrt(tl.maximum(square, _TINY))
    s0, s1, s2 = tl.where(seen, s0, 1.0), tl.where(seen, s1, 1.0), tl.where(seen, s2, 1.0)
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation(qw * norm, qx * norm, qy * norm, qz * norm)
    b00, b10, b20, jx0, jy0, h0 = along_axis(
        w00, w01, w02, w10, w11, w12, w20, w21, w22, r00, r10, r20, s0, fx, fy, u, v, us, vs, iz
    )
    b01, b11, b21, jx1, jy1, h1 = along_axis(
        w00, w01, w02, w10, w11, w12, w20, w21, w22, r01, r11, r21, s1, fx, fy, u, v, us, vs, iz
    )
    b02, b12, b22, jx2, jy2, h2 = along_axis(
        w00, w01, w02, w10, w11, w12, w20, w21, w22, r02, r12, r22, s2, fx, fy, u, v, us, vs, iz
    )
    xx, yy = lowpass + jx0 * jx0 + jx1 * jx1 + jx2 * jx2, lowpass + jy0 * jy0 + jy1 * jy1 + jy2 * jy2
    xy = jx0 * jy0 + jx1 * jy1 + jx2 * jy2
    det = xx * yy - xy * xy
    seen &= det > 0
    if antialiased:
        _, share = compensation(jx0, jy0, jx1, jy1, jx2, jy2, xx + yy, lowpass)
        opacity *= tl.sqrt(tl.where(seen, share, 1.0))
        seen &= opacity > _ALPHA_MIN
    idet = 1.0 / tl.where(seen, det, 1.0)
    qa, qb, qc = yy * idet, -xy * idet, xx * idet
    # inverse variance a0 along the ray, p = L m / a0, tilt
    a0 = h0 * h0 + h1 * h1 + h2 * h2
    ia0 = 1.0 / tl.where(seen, a0, 1.0)
    h0, h1, h2 = h0 / s0 * ia0, h1 / s1 * ia0, h2 / s2 * ia0
    p0, p1, p2 = b00 * h0 + b01 * h1 + b02 * h2, b10 * h0 + b11 * h1 + b12 * h2, b20 * h0 + b21 * h1 + b22 * h2
    q0, q1, eps = u * 0, u * 0, u * 0
    if solid:
        q0, q1, eps = p0 / fx, p1 / fy, iz * iz * ia0
    cutoff = 2.0 * tl.log(tl.where(seen, opacity, 1.0) / _ALPHA_MIN)

    # bounding box of the pixels with alpha >= 1/255; unbounded if they reach the camera plane
    near_plane = 1.0 - cutoff * eps
    box_xx, box_xy = near_plane * qa - cutoff * q0 * q0, near_plane * qb - cutoff * q0 * q1
    box_yy = near_plane * qc - cutoff * q1 * q1
    box_det = box_xx * box_yy - box_xy * box_xy
    seen &= (near_plane > 0) & (box_xx > 0) & (box_det > 0)
    idet = 1.0 / tl.where(seen, box_det, 1.0)
    inv_xx, inv_xy, inv_yy = box_yy * idet, -box_xy * idet, box_xx * idet
    dx, dy = cutoff * (inv_xx * q0 + inv_xy * q1), cutoff * (inv_xy * q0 + inv_yy * q1)
    radius2 = cutoff * (1.0 + q0 * dx + q1 * dy)
    half_x = tl.sqrt(tl.where(seen, inv_xx * radius2, 0.0))
    half_y = tl.sqrt(tl.where(seen, inv_yy * radius2, 0.0))
    uc, vc = fx * u + cx, fy * v + cy
    left, right = tl.maximum(uc + dx - half_x, -1.0), tl.minimum(uc + dx + half_x, width + 0.0)
    top, bottom = tl.maximum(vc + dy - half_y, -1.0), tl.minimum(vc + dy + half_y, height + 0.0)
    seen &= (left <= right) & (top <= bottom)
    left, top = tl.where(seen, left, 0.0), tl.where(seen, top, 0.0)
    right, bottom = tl.where(seen, right, 0.0), tl.where(seen, bottom, 0.0)
    x0, x1 = tl.maximum(_ceil(left), 0), tl.minimum(_floor(right), width - 1)
    y0, y1 = tl.maximum(_ceil(top), 0), tl.minimum(_floor(bottom), height - 1)
    seen &= (x0 <= x1) & (y0 <= y1)
    x0, y0 = x0 // _TILE, y0 // _TILE
    columns, rows = x1 // _TILE - x0 + 1, y1 // _TILE - y0 + 1

    length = -1.0 / tl.sqrt(tl.where(seen, p0 * p0 + p1 * p1 + p2 * p2, 1.0))
    # from the camera's centre to the mean, in the world's frame
    d0, d1, d2 = w00 * x + w10 * y + w20 * z, w01 * x + w11 * y + w21 * z, w02 * x + w12 * y + w22 * z
    far = 1.0 / tl.sqrt(tl.where(seen, d0 * d0 + d1 * d1 + d2 * d2, 1.0))
    d0, d1, d2 = d0 * far, d1 * far, d2 * far
    slot = tl.program_id(1).to(tl.int64) * total + i
    g = records + slot * _RECORD
    tl.store(g, uc, mask=seen)
    tl.store(g + 1, vc, mask=seen)
    tl.store(g + 2, qa, mask=seen)
    tl.store(g + 3, qb, mask=seen)
    tl.store(g + 4, qc, mask=seen)
    tl.store(g + 5, q0, mask=seen)
    tl.store(g + 6, q1, mask=seen)
    tl.store(g + 7, z, mask=seen)
    tl.store(g + 8, a0, mask=seen)
    tl.store(g + 9, cutoff, mask=seen)
    tl.store(g + 10, p0 * length, mask=seen)
    tl.store(g + 11, p1 * length, mask=seen)
    tl.store(g + 12, p2 * length, mask=seen)
    tl.store(g + 13, tl.maximum(shade(coefficients, d0, d1, d2, seen, degree), 0.0), mask=seen)
    tl.store(g + 14, tl.maximum(shade(coefficients + 1, d0, d1, d2, seen, degree), 0.0), mask=seen)
    tl.store(g + 15, tl.maximum(shade(coefficients + 2, d0, d1, d2, seen, degree), 0.0), mask=seen)
    tl.store(rects + 2 * slot, y0 * across + x0, mask=seen)
    tl.store(rects + 2 * slot + 1, columns, mask=seen)
    tiles = tl.where(seen, columns * rows, 0).to(tl.int64)
    tl.store(counts + slot, tl.where(good, tiles, _REFUSED), mask=there)


@triton.jit
def _floor(x):
    cut = x.to(tl.int32)
    return tl.where(cut > x, cut - 1, cut)


@triton.jit
def _ceil(x):
    cut = x.to(tl.int32)
    return tl.where(cut < x, cut + 1, cut)
