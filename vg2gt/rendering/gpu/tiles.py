"""Triton kernels over tiles: blending with median depth, and its backward pass.

One program is one warp and one tile of 8 x 8 pixels of one view: a vector of 64 rays. Gaussians are read one at a time,
front to back, as scalars. A stopped ray has a negative transmittance. Nothing is kept per hit: every step of the depth
solver visits the tile's Gaussians again, up to the last that can affect the median. Options are compile-time constants,
so that float64 (for tests) keeps their digits. Loops are ``while`` loops because the interpreter cannot iterate over a
tensor's range.
"""

# pyright: reportGeneralTypeIssues=false, reportOperatorIssue=false, reportArgumentType=false
# (Triton's type hints do not cover the operators and ranges used inside kernels)

from __future__ import annotations

import triton  # pyright: ignore[reportMissingImports]
import triton.language as tl  # pyright: ignore[reportMissingImports]

TILE = 8
RECORD = 16
"""Number of values per Gaussian and view: centre (2), conic (3), tilt (2), z, a0, cutoff, normal (3), colour (3).

Gradients have the same layout; the entry of the cutoff holds the gradient of the log opacity.
"""

_TILE = tl.constexpr(TILE)
_RAYS = tl.constexpr(TILE * TILE)
_RECORD = tl.constexpr(RECORD)
_ALPHA_MIN = tl.constexpr(1.0 / 255.0)
SIZES = ("height", "width", "across", "tiles")


@triton.jit
def _rays(tile, across, height, width):
    """Returns pixel coordinates of a tile's rays, and whether they lie in the image."""
    lane = tl.arange(0, _RAYS)
    x = (tile % across) * _TILE + lane % _TILE
    y = (tile // across) * _TILE + lane // _TILE
    return x, y, (x < width) & (y < height)


@triton.jit
def _respond(g, x, y, alpha_max: tl.constexpr, solid: tl.constexpr):
    """Returns a Gaussian's response along rays: offsets, E, 1 + s, r, 1 / r, eps, whether it is a hit, and alpha."""
    dx, dy = x - tl.load(g), y - tl.load(g + 1)
    e = (tl.load(g + 2) * dx + 2 * tl.load(g + 3) * dy) * dx + tl.load(g + 4) * dy * dy
    s, r, inverse, eps = dx * 0 + 1.0, dx * 0 + 1.0, dx * 0 + 1.0, tl.load(g + 9) * 0
    cutoff = tl.load(g + 9)
    if solid:
        z = tl.load(g + 7)
        eps = 1.0 / (z * z * tl.load(g + 8))
        s = 1.0 + tl.load(g + 5) * dx + tl.load(g + 6) * dy
        r = s * s + eps * e
    on = (e <= cutoff * r) & (s > 0)
    if solid:
        r = tl.where(on, r, 1.0)
        inverse = 1.0 / r
    # the opacity is exp(cutoff / 2) / 255
    alpha = tl.exp(0.5 * (cutoff - tl.where(on, e, 0.0) * inverse)) * _ALPHA_MIN
    return dx, dy, e, s, r, inverse, eps, on, tl.minimum(alpha, alpha_max)


@triton.jit(do_not_specialize=SIZES)
def blend_kernel(
    records, members, starts, background, color, normal, depth, alphas, transmittance, slopes,
    height, width, across, tiles,
    near: tl.constexpr, alpha_max: tl.constexpr, stop: tl.constexpr, negligible: tl.constexpr,
    median_max: tl.constexpr, sigmas: tl.constexpr, steps: tl.constexpr, newton: tl.constexpr,
    converged: tl.constexpr, solid: tl.constexpr, geometry: tl.constexpr, mean: tl.constexpr,
):  # fmt: skip
    """Blends a tile front to back and computes its depth: median, or expected with ``mean`` (rasterized only)."""
    dtype = records.dtype.element_ty
    view = (tl.program_id(0) // tiles).to(tl.int64)
    x, y, inside = _rays(tl.program_id(0) % tiles, across, height, width)
    px, py = x.to(dtype), y.to(dtype)
    before = tl.where(inside, 1.0, -1.0).to(dtype)
    zero = px * 0
    c0, c1, c2, n0, n1, n2, expected, crossing, hi, far = zero, zero, zero, zero, zero, zero, zero, zero, zero, zero
    lo = zero + 1e30
    begin, end = tl.load(starts + tl.program_id(0)), tl.load(starts + tl.program_id(0) + 1)
    place, last = begin, begin
    live = place < end
    while live:
        g = records + tl.load(members + place).to(tl.int64) * _RECORD
        _, _, _, s, r, inverse, _, on, alpha = _respond(g, px, py, alpha_max, solid)
        on = on & (before > 0)
        if tl.max(on.to(tl.int32), 0) > 0:
            after = before * (1.0 - alpha)
            kept = on & (after >= stop)
            weight = tl.where(kept, alpha * before, 0.0)
            c0 += weight * tl.load(g + 13)
            c1 += weight * tl.load(g + 14)
            c2 += weight * tl.load(g + 15)
            if geometry:
                n0 += weight * tl.load(g + 10)
                n1 += weight * tl.load(g + 11)
                n2 += weight * tl.load(g + 12)
                peak = tl.load(g + 7) * s * inverse
                if solid:
                    precision = tl.load(g + 8) * r
                    reach = sigmas / tl.sqrt(precision)
                    early = before > 0.25
                    lo = tl.where(kept, tl.minimum(lo, peak - reach), lo)
                    far = tl.where(kept, tl.maximum(far, peak + reach), far)
                    hi = tl.where(kept & early, tl.maximum(hi, peak), hi)
                    beyond = tl.maximum(peak - hi, 0.0)
                    matters = kept & (early | (precision * beyond * beyond <= negligible))
                    last = tl.where(tl.max(matters.to(tl.int32), 0) > 0, place + 1, last)
                else:
                    expected += weight * peak
                crossing = tl.where(kept & (before > 0.5) & (after <= 0.5), peak, crossing)
            before = tl.where(kept, after, tl.where(on, -before, before))
        place += 1
        live = (place < end) & (tl.max(before, 0) > 0)
    final = tl.abs(before)
    plane = height * width
    pixel = view * plane + y * width + x
    channel = pixel + 2 * view * plane
    tl.store(color + channel, c0 + final * tl.load(background), mask=inside)
    tl.store(color + channel + plane, c1 + final * tl.load(background + 1), mask=inside)
    tl.store(color + channel + 2 * plane, c2 + final * tl.load(background + 2), mask=inside)
    tl.store(alphas + pixel, 1.0 - final, mask=inside)
    tl.store(transmittance + pixel, final, mask=inside)
    if geometry:
        tl.store(normal + channel, n0, mask=inside)
        tl.store(normal + channel + plane, n1, mask=inside)
        tl.store(normal + channel + 2 * plane, n2, mask=inside)
        if solid:
            solvable = inside & (final < median_max)
            hi = tl.where(final > 0.25, far, hi)
            d, steep = _median(
                records, members, begin, last, px, py, solvable, lo, hi, crossing,
                near, alpha_max, stop, steps, newton, converged,
            )  # fmt: skip
            tl.store(depth + pixel, d, mask=inside)
            tl.store(slopes + pixel, 0.5 * steep, mask=inside)
        elif mean:
            covered = 1.0 - final
            hit = covered > 0
            tl.store(depth + pixel, tl.where(hit, expected / tl.where(hit, covered, 1.0), 0.0), mask=inside)
        else:
            tl.store(depth + pixel, crossing, mask=inside)


@triton.jit
def _median(
    records, members, begin, last, px, py, solvable, lo, hi, guess,
    near: tl.constexpr, alpha_max: tl.constexpr, stop: tl.constexpr, steps: tl.constexpr, newton: tl.constexpr,
    converged: tl.constexpr,
):  # fmt: skip
    """Returns the median depth in ``lo .. hi`` (0: none), and ``-2 d ln T / dt`` there.

    Takes a Newton step where it stays within the bracket and is at most half the last step, else bisects; visits only
    the hits of rays that still move. Begins at ``guess`` if it lies in the bracket.
    """
    cut = solvable & (lo < near)
    lo, hi = tl.where(solvable, tl.maximum(lo, near), 1.0), tl.where(solvable, hi, 1.0)
    hi = tl.maximum(hi, lo)
    if tl.max(cut.to(tl.int32), 0) > 0:  # the near plane cuts the bracket: the median must not lie in front of it
        numerator, denominator, _ = _transmit(records, members, begin, last, px, py, solvable, lo, alpha_max, stop)
        solvable = solvable & (numerator > 0.25 * denominator)
    d = 0.5 * (lo + hi)
    if newton:
        d = tl.where((guess > lo) & (guess < hi), guess, d)
    moving, step, steep = solvable, lo * 0 + 1e30, lo * 0
    number = 0
    live = tl.max(moving.to(tl.int32), 0) > 0
    while live & (number < steps):
        numerator, denominator, slope = _transmit(records, members, begin, last, px, py, moving, d, alpha_max, stop)
        nearer = 4.0 * numerator > denominator
        lo, hi = tl.where(moving & nearer, d, lo), tl.where(moving & (nearer == 0), d, hi)
        moved = 0.5 * (lo + hi)
        if newton:
            sloped = slope > 0
            aim = d + tl.log(4.0 * numerator / denominator) / tl.where(sloped, slope, 1.0)
            moved = tl.where(sloped & (aim >= lo) & (aim <= hi) & (tl.abs(aim - d) <= 0.5 * step), aim, moved)
            steep = tl.where(moving, slope, steep)
        step = tl.abs(moved - d)
        d = tl.where(moving, moved, d)
        moving = moving & (step > converged * moved)
        number += 1
        live = tl.max(moving.to(tl.int32), 0) > 0
    if newton == 0:
        _, _, steep = _transmit(records, members, begin, last, px, py, solvable, d, alpha_max, stop)
    return tl.where(solvable, d, 0.0), steep


@triton.jit
def _transmit(records, members, place, last, px, py, wanted, t, alpha_max: tl.constexpr, stop: tl.constexpr):
    """Returns squared transmittance at depths ``t`` (numerator, denominator), and ``-2 d ln T / dt``."""
    before = tl.where(wanted, 1.0, -1.0).to(px.dtype)
    numerator, denominator, steep = px * 0 + 1.0, px * 0 + 1.0, px * 0
    live = place < last
    while live:
        g = records + tl.load(members + place).to(tl.int64) * _RECORD
        _, _, _, s, r, inverse, _, on, alpha = _respond(g, px, py, alpha_max, True)
        on = on & (before > 0)
        after = before * (1.0 - alpha)
        kept = on & (after >= stop)
        if tl.max(on.to(tl.int32), 0) > 0:
            alpha = tl.where(kept, alpha, 0.0)
            precision = tl.load(g + 8) * r
            offset = t - tl.load(g + 7) * s * inverse
            bell = alpha * tl.exp(-0.5 * precision * offset * offset)
            free = 1.0 - bell
            numerator *= tl.where(offset <= 0, free, (1.0 - alpha) * (1.0 - alpha))
            denominator *= tl.where(offset <= 0, 1.0, free)
            steep += bell * precision * tl.abs(offset) / free
        before = tl.where(kept, after, tl.where(on, -before, before))
        place += 1
        live = (place < last) & (tl.max(before, 0) > 0)
    return numerator, denominator, steep


@triton.jit(do_not_specialize=(*SIZES, "views", "first_view", "some_views", "base"))
def backward_kernel(
    records, members, places, starts, color, normal, depth, transmittance, slopes,
    grad_color, grad_normal, grad_depth, grad_alpha, rows, sums,
    height, width, across, tiles, views, first_view, some_views, base,
    alpha_max: tl.constexpr, stop: tl.constexpr, slope_floor: tl.constexpr, tiny: tl.constexpr,
    solid: tl.constexpr, geometry: tl.constexpr, mean: tl.constexpr, absolute: tl.constexpr,
):  # fmt: skip
    """Visits a tile's Gaussians front to back again and writes the gradient row of each (rows start at zero).

    With ``absolute``, ``sums`` gets the sums over pixels of absolute gradients of the centre (2 values a row).
    Covers ``some_views`` of each scene's ``views``, from ``first_view`` on; their rows begin at ``base``.
    """
    dtype = records.dtype.element_ty
    number = tl.program_id(0) // tiles
    view = number // some_views * views + first_view + number % some_views
    tile = tl.program_id(0) % tiles
    x, y, inside = _rays(tile, across, height, width)
    px, py = x.to(dtype), y.to(dtype)
    before = tl.where(inside, 1.0, -1.0).to(dtype)
    plane = height * width
    pixel = view.to(tl.int64) * plane + y * width + x
    channel = pixel + 2 * view.to(tl.int64) * plane
    final = tl.load(transmittance + pixel, mask=inside, other=0.0)
    g0 = tl.load(grad_color + channel, mask=inside, other=0.0)
    g1 = tl.load(grad_color + channel + plane, mask=inside, other=0.0)
    g2 = tl.load(grad_color + channel + 2 * plane, mask=inside, other=0.0)
    # rest: incoming gradients times all contributions still ahead on the ray, for the gradient of alpha
    rest = g0 * tl.load(color + channel, mask=inside, other=0.0)
    rest += g1 * tl.load(color + channel + plane, mask=inside, other=0.0)
    rest += g2 * tl.load(color + channel + 2 * plane, mask=inside, other=0.0)
    rest -= final * tl.load(grad_alpha + pixel, mask=inside, other=0.0)
    zero = px * 0
    g3, g4, g5, median, kd, toward, to_crossing = zero, zero, zero, zero, zero, zero, zero
    if geometry:
        g3 = tl.load(grad_normal + channel, mask=inside, other=0.0)
        g4 = tl.load(grad_normal + channel + plane, mask=inside, other=0.0)
        g5 = tl.load(grad_normal + channel + 2 * plane, mask=inside, other=0.0)
        rest += g3 * tl.load(normal + channel, mask=inside, other=0.0)
        rest += g4 * tl.load(normal + channel + plane, mask=inside, other=0.0)
        rest += g5 * tl.load(normal + channel + 2 * plane, mask=inside, other=0.0)
        median = tl.load(depth + pixel, mask=inside, other=0.0)
        incoming = tl.where(median > 0, tl.load(grad_depth + pixel, mask=inside, other=0.0), 0.0)
        if solid:
            steep = tl.load(slopes + pixel, mask=inside, other=1.0)
            steep = tl.maximum(steep, slope_floor / tl.where(median > 0, median, 1.0))
            kd = incoming / tl.maximum(steep, tiny)
        elif mean:
            toward = incoming / tl.where(median > 0, 1.0 - final, 1.0)
            rest += toward * median  # quotient rule: numerator and denominator, (1 - T) + T
        else:
            to_crossing = incoming
    place, end = tl.load(starts + view * tiles + tile), tl.load(starts + view * tiles + tile + 1)
    live = place < end
    while live:
        g = records + tl.load(members + place).to(tl.int64) * _RECORD
        dx, dy, e, s, r, inverse, eps, on, alpha = _respond(g, px, py, alpha_max, solid)
        on = on & (before > 0)
        if tl.max(on.to(tl.int32), 0) > 0:
            row = rows + (tl.load(places + place) - base).to(tl.int64) * _RECORD
            z, a0 = tl.load(g + 7), tl.load(g + 8)
            after = before * (1.0 - alpha)
            kept = on & (after >= stop)
            alpha = tl.where(kept, alpha, 0.0)
            weight = alpha * before
            peak = z * s * inverse
            value = g0 * tl.load(g + 13) + g1 * tl.load(g + 14) + g2 * tl.load(g + 15)
            tl.store(row + 13, tl.sum(weight * g0, 0))
            tl.store(row + 14, tl.sum(weight * g1, 0))
            tl.store(row + 15, tl.sum(weight * g2, 0))
            if geometry:
                value += g3 * tl.load(g + 10) + g4 * tl.load(g + 11) + g5 * tl.load(g + 12) + toward * peak
                tl.store(row + 10, tl.sum(weight * g3, 0))
                tl.store(row + 11, tl.sum(weight * g4, 0))
                tl.store(row + 12, tl.sum(weight * g5, 0))
            rest -= weight * value
            free = 1.0 / (1.0 - alpha)
            slack = before * value - rest * free
            gt, gp = zero, zero
            if geometry:
                if solid:
                    # implicit gradient of the median (paper, eqn tmed_grad), scaled by kd = incoming / S
                    d = median - peak
                    bell = tl.exp(-0.5 * a0 * r * d * d)
                    gauss = alpha * bell
                    half = 0.5 * kd / (1.0 - gauss)
                    slack += tl.where(d > 0, half * bell - kd * free, -half * bell)
                    pull = half * gauss * tl.abs(d)
                    gt = tl.where(kept, pull * a0 * r, 0.0)
                    gp = tl.where(kept, -0.5 * pull * d, 0.0)
                else:
                    gt = weight * toward + tl.where(kept & (before > 0.5) & (after <= 0.5), to_crossing, 0.0)
            # chain rule to the response
            ga = tl.where(kept & (alpha < alpha_max), slack * alpha, 0.0)
            ge = -0.5 * ga * inverse
            z_gradient = tl.sum(gt * s * inverse, 0)
            qb = tl.load(g + 3)
            if solid:
                gr = tl.where(kept, -ge * e * inverse - gt * peak * inverse + gp * a0, 0.0)
                ge += gr * eps
                gs = gt * z * inverse + 2.0 * gr * s
                tilted = tl.sum(gs, 0)
                curved = tl.sum(gr * e, 0) * eps  # eps = 1 / (z^2 a0) is not an independent input
                sx, sy = tl.sum(ge * dx, 0), tl.sum(ge * dy, 0)
                tl.store(row, -2.0 * (tl.load(g + 2) * sx + qb * sy) - tilted * tl.load(g + 5))
                tl.store(row + 1, -2.0 * (qb * sx + tl.load(g + 4) * sy) - tilted * tl.load(g + 6))
                tl.store(row + 5, tl.sum(gs * dx, 0))
                tl.store(row + 6, tl.sum(gs * dy, 0))
                tl.store(row + 7, z_gradient - 2.0 * curved / z)
                tl.store(row + 8, tl.sum(gp * r, 0) - curved / a0)
            else:
                sx, sy = tl.sum(ge * dx, 0), tl.sum(ge * dy, 0)
                tl.store(row, -2.0 * (tl.load(g + 2) * sx + qb * sy))
                tl.store(row + 1, -2.0 * (qb * sx + tl.load(g + 4) * sy))
                tl.store(row + 7, z_gradient)
            if absolute:
                pull_x, pull_y = tl.load(g + 2) * dx + qb * dy, qb * dx + tl.load(g + 4) * dy
                gx, gy = 2.0 * ge * pull_x, 2.0 * ge * pull_y
                if solid:
                    gx, gy = gx + gs * tl.load(g + 5), gy + gs * tl.load(g + 6)
                to = sums + (tl.load(places + place) - base).to(tl.int64) * 2
                tl.store(to, tl.sum(tl.abs(gx), 0))
                tl.store(to + 1, tl.sum(tl.abs(gy), 0))
            tl.store(row + 2, tl.sum(ge * dx * dx, 0))
            tl.store(row + 3, 2.0 * tl.sum(ge * dx * dy, 0))
            tl.store(row + 4, tl.sum(ge * dy * dy, 0))
            tl.store(row + 9, tl.sum(ga, 0))
            before = tl.where(kept, after, tl.where(on, -before, before))
        place += 1
        live = (place < end) & (tl.max(before, 0) > 0)
