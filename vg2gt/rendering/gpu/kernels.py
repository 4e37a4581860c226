"""Triton kernels: blend, solve, and the backward visit (formulas: vg2gt/rendering/projection.py).

One program is one warp and one tile of 8 x 8 pixels, a vector of 64 rays. Gaussians are read one at a time, in order,
as scalars; one that no ray of the tile hits costs a comparison. Rays are stopped by the sign of their transmittance.
Options are compile-time constants, so that float64 (for tests) keeps their digits. Loops are ``while`` loops because
the interpreter cannot iterate over a tensor's range. Hits lie in three planes (alpha, peak, precision) of ``plane``
values, each hit number of all ``pixels`` side by side.
"""

# pyright: reportGeneralTypeIssues=false, reportOperatorIssue=false
# (inside a kernel the operators and ranges are Triton's language, which its type hints do not describe)

from __future__ import annotations

import triton  # pyright: ignore[reportMissingImports]
import triton.language as tl  # pyright: ignore[reportMissingImports]

TILE = 8
RECORD = 18  # centre 2, conic 3, tilt 2, z, a0, eps, opacity, cutoff, normal 3, colour 3; gradient rows alike

_TILE = tl.constexpr(TILE)
_RAYS = tl.constexpr(TILE * TILE)
_RECORD = tl.constexpr(RECORD)


@triton.jit
def _rays(tile, across, tiles, height, width):
    """Pixel coordinates of a tile's rays, whether they lie in the image, and their index over all views."""
    lane = tl.arange(0, _RAYS)
    inner = tile % tiles
    x = (inner % across) * _TILE + lane % _TILE
    y = (inner // across) * _TILE + lane // _TILE
    return x, y, (x < width) & (y < height), (tile // tiles).to(tl.int64) * height * width + y * width + x


@triton.jit
def _respond(g, x, y, alpha_max: tl.constexpr):
    """A Gaussian's response along rays: offsets, E, 1 + s, r, its inverse, whether it counts, and alpha."""
    dx, dy = x - tl.load(g), y - tl.load(g + 1)
    e = (tl.load(g + 2) * dx + 2 * tl.load(g + 3) * dy) * dx + tl.load(g + 4) * dy * dy
    s = 1.0 + tl.load(g + 5) * dx + tl.load(g + 6) * dy
    r = s * s + tl.load(g + 9) * e
    on = (e <= tl.load(g + 11) * r) & (s > 0)
    r = tl.where(on, r, 1.0)
    inverse = 1.0 / r
    alpha = tl.minimum(tl.load(g + 10) * tl.exp(-0.5 * tl.where(on, e, 0.0) * inverse), alpha_max)
    return dx, dy, e, s, r, inverse, on, alpha


@triton.jit
def blend_kernel(
    records, members, starts, background, color, normal, transmittance, mean, median, high, counts, hits,
    height, width, across, tiles, pixels, capacity, plane,
    alpha_max: tl.constexpr, stop: tl.constexpr, negligible: tl.constexpr, geometry: tl.constexpr, solid: tl.constexpr,
):  # fmt: skip
    """Blends a tile front to back and, for solid depth, keeps the hits that can matter to the median."""
    dtype = records.dtype.element_ty
    x, y, inside, pixel = _rays(tl.program_id(0), across, tiles, height, width)
    px, py = x.to(dtype), y.to(dtype)
    before = tl.where(inside, 1.0, -1.0).to(dtype)
    zero = tl.zeros([_RAYS], dtype)
    c0, c1, c2, n0, n1, n2, expected, crossing, hi = zero, zero, zero, zero, zero, zero, zero, zero, zero
    count = tl.zeros([_RAYS], tl.int32)
    place, end = tl.load(starts + tl.program_id(0)), tl.load(starts + tl.program_id(0) + 1)
    live = place < end
    while live:
        g = records + tl.load(members + place).to(tl.int64) * _RECORD
        _, _, _, s, r, inverse, on, alpha = _respond(g, px, py, alpha_max)
        on = on & (before > 0)
        if tl.max(on.to(tl.int32), 0) > 0:
            after = before * (1.0 - alpha)
            kept = on & (after >= stop)
            weight = tl.where(kept, alpha * before, 0.0)
            c0 += weight * tl.load(g + 15)
            c1 += weight * tl.load(g + 16)
            c2 += weight * tl.load(g + 17)
            if geometry:
                n0 += weight * tl.load(g + 12)
                n1 += weight * tl.load(g + 13)
                n2 += weight * tl.load(g + 14)
                peak = tl.load(g + 7) * s * inverse
                if solid:
                    precision = tl.load(g + 8) * r
                    early = before > 0.25
                    hi = tl.where(kept & early, tl.maximum(hi, peak), hi)
                    beyond = tl.maximum(peak - hi, 0.0)
                    kept_hit = kept & (early | (precision * beyond * beyond <= negligible))
                    slot = hits + count.to(tl.int64) * pixels + pixel
                    store = kept_hit & (count < capacity)
                    tl.store(slot, alpha, mask=store)
                    tl.store(slot + plane, peak, mask=store)
                    tl.store(slot + 2 * plane, precision, mask=store)
                    count += kept_hit.to(tl.int32)
                else:
                    expected += weight * peak
                    crossing = tl.where(kept & (before > 0.5) & (after <= 0.5), peak, crossing)
            before = tl.where(kept, after, tl.where(on, -before, before))
        place += 1
        live = (place < end) & (tl.max(before, 0) > 0)
    final = tl.abs(before)
    tl.store(color + pixel * 3, c0 + final * tl.load(background), mask=inside)
    tl.store(color + pixel * 3 + 1, c1 + final * tl.load(background + 1), mask=inside)
    tl.store(color + pixel * 3 + 2, c2 + final * tl.load(background + 2), mask=inside)
    tl.store(transmittance + pixel, final, mask=inside)
    if geometry:
        tl.store(normal + pixel * 3, n0, mask=inside)
        tl.store(normal + pixel * 3 + 1, n1, mask=inside)
        tl.store(normal + pixel * 3 + 2, n2, mask=inside)
        if solid:
            tl.store(high + pixel, hi, mask=inside)
            tl.store(counts + pixel, count, mask=inside)
        else:
            tl.store(mean + pixel, expected, mask=inside)
            tl.store(median + pixel, crossing, mask=inside)


@triton.jit
def _transmit(slot, plane, pixels, count, most, t):
    """Squared transmittance at depths ``t`` as a quotient, and ``-2 d ln T / dt``: one exponential per hit."""
    numerator, denominator, slope = t * 0 + 1.0, t * 0 + 1.0, t * 0
    c = 0
    while c < most:
        there = c < count
        alpha = tl.load(slot, mask=there, other=0.0)
        peak = tl.load(slot + plane, mask=there, other=0.0)
        precision = tl.load(slot + 2 * plane, mask=there, other=0.0)
        d = t - peak
        g = alpha * tl.exp(-0.5 * precision * d * d)
        front = d <= 0
        numerator *= tl.where(front, 1.0 - g, (1.0 - alpha) * (1.0 - alpha))
        denominator *= tl.where(front, 1.0, 1.0 - g)
        slope += g * precision * tl.abs(d) / (1.0 - g)
        slot += pixels
        c += 1
    return numerator, denominator, slope


@triton.jit
def solve_kernel(
    hits, counts, high, transmittance, depth, slope, height, width, across, tiles, pixels, plane,
    near: tl.constexpr, median_max: tl.constexpr, sigmas: tl.constexpr,
    bisections: tl.constexpr, newton_steps: tl.constexpr,
):  # fmt: skip
    """Median depth by bisection and Newton steps (0: none), and its slope S."""
    _, _, inside, pixel = _rays(tl.program_id(0), across, tiles, height, width)
    final = tl.load(transmittance + pixel, mask=inside, other=1.0)
    count = tl.load(counts + pixel, mask=inside & (final < median_max), other=0)
    most = tl.max(count, 0)
    hi = tl.load(high + pixel, mask=inside, other=0.0)
    wide = final > 0.25
    hi = tl.where(wide, 0.0, hi)
    lo = hi * 0 + 1e30
    slot = hits + pixel
    c = 0
    while c < most:
        there = c < count
        peak = tl.load(slot + plane, mask=there, other=0.0)
        reach = sigmas / tl.sqrt(tl.load(slot + 2 * plane, mask=there, other=1.0))
        lo = tl.where(there, tl.minimum(lo, peak - reach), lo)
        hi = tl.where(there & wide, tl.maximum(hi, peak + reach), hi)
        slot += pixels
        c += 1
    slot = hits + pixel
    lo = tl.maximum(lo, near)
    numerator, denominator, _ = _transmit(slot, plane, pixels, count, most, lo)
    solvable = (count > 0) & (numerator > 0.25 * denominator)
    for _ in tl.static_range(bisections):
        middle = 0.5 * (lo + hi)
        numerator, denominator, _ = _transmit(slot, plane, pixels, count, most, middle)
        nearer = numerator > 0.25 * denominator
        lo = tl.where(nearer, middle, lo)
        hi = tl.where(nearer, hi, middle)
    d = 0.5 * (lo + hi)
    for _ in tl.static_range(newton_steps):
        numerator, denominator, steep = _transmit(slot, plane, pixels, count, most, d)
        step = tl.log(4.0 * numerator / denominator) / tl.where(steep > 0, steep, 1.0)
        d = tl.minimum(tl.maximum(d + tl.where(steep > 0, step, 0.0), lo), hi)
    _, _, steep = _transmit(slot, plane, pixels, count, most, d)
    tl.store(depth + pixel, tl.where(solvable, d, 0.0), mask=inside)
    tl.store(slope + pixel, 0.5 * steep, mask=inside)


@triton.jit
def backward_kernel(
    records, members, places, starts, color, normal, depth, transmittance,
    grad_color, grad_normal, grad_alpha, grad_solid, grad_expected, grad_crossing, rows,
    height, width, across, tiles, alpha_max: tl.constexpr, stop: tl.constexpr, geometry: tl.constexpr,
):  # fmt: skip
    """Visits a tile's Gaussians front to back again and writes one gradient row for each (rows start at zero)."""
    dtype = records.dtype.element_ty
    x, y, inside, pixel = _rays(tl.program_id(0), across, tiles, height, width)
    px, py = x.to(dtype), y.to(dtype)
    before = tl.where(inside, 1.0, -1.0).to(dtype)
    final = tl.load(transmittance + pixel, mask=inside, other=0.0)
    g0 = tl.load(grad_color + pixel * 3, mask=inside, other=0.0)
    g1 = tl.load(grad_color + pixel * 3 + 1, mask=inside, other=0.0)
    g2 = tl.load(grad_color + pixel * 3 + 2, mask=inside, other=0.0)
    rest = g0 * tl.load(color + pixel * 3, mask=inside, other=0.0)
    rest += g1 * tl.load(color + pixel * 3 + 1, mask=inside, other=0.0)
    rest += g2 * tl.load(color + pixel * 3 + 2, mask=inside, other=0.0)
    rest -= final * tl.load(grad_alpha + pixel, mask=inside, other=0.0)
    zero = tl.zeros([_RAYS], dtype)
    g3, g4, g5, median, kd, toward, to_crossing = zero, zero, zero, zero, zero, zero, zero
    if geometry:
        g3 = tl.load(grad_normal + pixel * 3, mask=inside, other=0.0)
        g4 = tl.load(grad_normal + pixel * 3 + 1, mask=inside, other=0.0)
        g5 = tl.load(grad_normal + pixel * 3 + 2, mask=inside, other=0.0)
        rest += g3 * tl.load(normal + pixel * 3, mask=inside, other=0.0)
        rest += g4 * tl.load(normal + pixel * 3 + 1, mask=inside, other=0.0)
        rest += g5 * tl.load(normal + pixel * 3 + 2, mask=inside, other=0.0)
        median = tl.load(depth + pixel, mask=inside, other=0.0)
        kd = tl.load(grad_solid + pixel, mask=inside, other=0.0)
        toward = tl.load(grad_expected + pixel, mask=inside, other=0.0)
        to_crossing = tl.load(grad_crossing + pixel, mask=inside, other=0.0)
        rest += toward * median * (1.0 - final)
    place, end = tl.load(starts + tl.program_id(0)), tl.load(starts + tl.program_id(0) + 1)
    live = place < end
    while live:
        g = records + tl.load(members + place).to(tl.int64) * _RECORD
        dx, dy, e, s, r, inverse, on, alpha = _respond(g, px, py, alpha_max)
        on = on & (before > 0)
        if tl.max(on.to(tl.int32), 0) > 0:
            z, a0 = tl.load(g + 7), tl.load(g + 8)
            after = before * (1.0 - alpha)
            kept = on & (after >= stop)
            alpha = tl.where(kept, alpha, 0.0)
            weight = alpha * before
            peak = z * s * inverse
            value = g0 * tl.load(g + 15) + g1 * tl.load(g + 16) + g2 * tl.load(g + 17)
            if geometry:
                value += g3 * tl.load(g + 12) + g4 * tl.load(g + 13) + g5 * tl.load(g + 14) + toward * peak
            rest -= weight * value
            free = 1.0 / (1.0 - alpha)
            slack = before * value - rest * free
            gt, gp = zero, zero
            if geometry:
                # implicit gradient of the median (paper, eqn tmed_grad), scaled by kd = incoming / S
                d = median - peak
                bell = tl.exp(-0.5 * a0 * r * d * d)
                gauss = alpha * bell
                half = 0.5 * kd / (1.0 - gauss)
                slack += tl.where(d > 0, half * bell - kd * free, -half * bell)
                pull = half * gauss * tl.abs(d)
                gt = pull * a0 * r + weight * toward
                gt = tl.where(kept, gt + tl.where((before > 0.5) & (after <= 0.5), to_crossing, 0.0), 0.0)
                gp = tl.where(kept, -0.5 * pull * d, 0.0)
            ga = tl.where(kept & (alpha < alpha_max), slack * alpha, 0.0)
            gd = -0.5 * ga
            gr = tl.where(kept, -gd * e * inverse * inverse - gt * peak * inverse + gp * a0, 0.0)
            ge = gd * inverse + gr * tl.load(g + 9)
            gs = gt * z * inverse + 2.0 * gr * s
            sx, sy, s1 = tl.sum(ge * dx, 0), tl.sum(ge * dy, 0), tl.sum(gs, 0)
            qb = tl.load(g + 3)
            row = rows + tl.load(places + place).to(tl.int64) * _RECORD
            tl.store(row, -2.0 * (tl.load(g + 2) * sx + qb * sy) - s1 * tl.load(g + 5))
            tl.store(row + 1, -2.0 * (qb * sx + tl.load(g + 4) * sy) - s1 * tl.load(g + 6))
            tl.store(row + 2, tl.sum(ge * dx * dx, 0))
            tl.store(row + 3, 2.0 * tl.sum(ge * dx * dy, 0))
            tl.store(row + 4, tl.sum(ge * dy * dy, 0))
            tl.store(row + 5, tl.sum(gs * dx, 0))
            tl.store(row + 6, tl.sum(gs * dy, 0))
            tl.store(row + 9, tl.sum(gr * e, 0))
            tl.store(row + 10, tl.sum(ga, 0) / tl.load(g + 10))
            tl.store(row + 15, tl.sum(weight * g0, 0))
            tl.store(row + 16, tl.sum(weight * g1, 0))
            tl.store(row + 17, tl.sum(weight * g2, 0))
            if geometry:
                tl.store(row + 7, tl.sum(gt * s * inverse, 0))
                tl.store(row + 8, tl.sum(gp * r, 0))
                tl.store(row + 12, tl.sum(weight * g3, 0))
                tl.store(row + 13, tl.sum(weight * g4, 0))
                tl.store(row + 14, tl.sum(weight * g5, 0))
            before = tl.where(kept, after, tl.where(on, -before, before))
        place += 1
        live = (place < end) & (tl.max(before, 0) > 0)
