"""Compiled forward pass over tiles of 16 x 16 pixels.

A tile's Gaussians are visited front to back; each touches the rows of its exact box, and a row of 16 pixels is one
vector operation: the innermost loops have a fixed length and no branch, so that they vectorise. All state of a tile
lies in planes of one flat scratch array, whose offsets are constants: with several arrays the compiler would have to
guard every loop against overlap. Rays are stopped by the sign of their transmittance. Kernels are generic in the dtype:
constants exact in float32 do not change the type they meet, others come in as an array.
"""

# Written for the compiler: flat bodies, short names from rendering/projection.py's formulas.

from __future__ import annotations

import math

import numpy as np
from numba import njit

from vg2gt.rendering.cpu.tiles import (
    ALPHA,
    BIG,
    C0,
    C1,
    C2,
    COUNT,
    DEN,
    FAST,
    FOUR,
    HALF,
    HI,
    HIT,
    HIT_PEAK,
    HIT_PRECISION,
    HIT_SIZE,
    LO,
    MEAN,
    MEDIAN,
    N0,
    N1,
    N2,
    NUM,
    ONE,
    PEAK,
    PLANE,
    PRECISION,
    QUARTER,
    SLOT,
    STAGED,
    TILE,
    TWO,
    ZERO,
    any_alive,
    exp,
    stage,
    start_rays,
)


@njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def _blend_tile(
    records, colors, boxes, members, x_tile, y_tile, geometry, solid, parameters, state, hits, staged, spans
):
    """Blends one tile front to back; returns the largest number of hits kept for the depth solver."""
    alpha_max, stop, negligible = parameters[0], parameters[1], parameters[4]
    capacity = len(hits) // (TILE * HIT_SIZE)
    last_slot = np.int32(capacity - 1)
    for p in range(len(members)):
        j = p % STAGED
        if j == 0:
            if not any_alive(state):
                break
            stage(records, colors, boxes, members[p : p + STAGED], x_tile, y_tile, staged, spans)
        g = staged[j]
        uc, vc, qa, qb, qc, q0, q1, z = g[0], g[1], g[2], g[3], g[4], g[5], g[6], g[7]
        a0, eps, opacity, cutoff = g[8], g[9], g[10], g[11]
        n0, n1, n2 = g[12], g[13], g[14]
        c0, c1, c2 = g[16], g[17], g[18]
        left = np.float32(x_tile) - uc
        first, last, top, bottom = spans[j, 0], spans[j, 1], spans[j, 2], spans[j, 3]
        for y in range(top, bottom):
            dy = np.float32(y_tile + y) - vc
            s_row, e_row, f_row = ONE + q1 * dy, qc * dy * dy, TWO * qb * dy
            base = np.uintp(y * TILE)
            if not geometry:
                for lane in range(TILE):
                    k = base + np.uintp(lane)
                    dx = left + np.float32(lane)
                    e = (qa * dx + f_row) * dx + e_row
                    s = q0 * dx + s_row
                    r = s * s + eps * e
                    before = state[k]
                    on = (e <= cutoff * r) & (s > ZERO) & (before > ZERO)
                    alpha = min(opacity * exp(-HALF * e / r), alpha_max)
                    alpha = alpha if on else ZERO
                    after = before * (ONE - alpha)
                    stopped = on & (after < stop)
                    weight = ZERO if stopped else alpha * before
                    state[k] = -before if stopped else after
                    state[k + C0] += weight * c0
                    state[k + C1] += weight * c1
                    state[k + C2] += weight * c2
                continue
            for lane in range(TILE):
                k = base + np.uintp(lane)
                dx = left + np.float32(lane)
                e = (qa * dx + f_row) * dx + e_row
                s = q0 * dx + s_row
                r = s * s + eps * e
                before = state[k]
                on = (e <= cutoff * r) & (s > ZERO) & (before > ZERO)
                r = r if on else ONE
                inverse = ONE / r
                alpha = min(opacity * exp(-HALF * e * inverse), alpha_max)
                alpha = alpha if on else ZERO
                after = before * (ONE - alpha)
                stopped = on & (after < stop)
                alpha = ZERO if stopped else alpha
                weight = alpha * before
                peak, precision = z * s * inverse, a0 * r
                state[k] = -before if stopped else after
                state[k + C0] += weight * c0
                state[k + C1] += weight * c1
                state[k + C2] += weight * c2
                state[k + N0] += weight * n0
                state[k + N1] += weight * n1
                state[k + N2] += weight * n2
                state[k + MEAN] += weight * peak
                crossing = (alpha > ZERO) & (before > HALF) & (after <= HALF)
                median = state[k + MEDIAN]
                state[k + MEDIAN] = peak if crossing else median
                state[k + ALPHA] = alpha
                state[k + PEAK] = peak
                state[k + PRECISION] = precision
                # the median is in front of HI: a hit that begins far behind does not matter to it
                early = before > QUARTER
                hi = state[k + HI]
                hi = max(hi, peak if early & (alpha > ZERO) else ZERO)
                state[k + HI] = hi
                beyond = peak - hi
                matters = (alpha > ZERO) & (early | (beyond <= ZERO) | (precision * beyond * beyond <= negligible))
                slot = state[k + COUNT]
                state[k + SLOT] = slot
                state[k + COUNT] = slot + (ONE if matters else ZERO)
        if not (geometry and solid):
            continue
        for y in range(top, bottom):  # a loop of its own: reading what was just written as a vector would stall
            base = np.uintp(y * TILE)
            for lane in range(first, last):  # without a branch: what does not matter is overwritten by the next hit
                k = base + np.uintp(lane)
                slot = np.uintp(min(np.int32(state[k + SLOT]), last_slot) + y * capacity) * HIT + np.uintp(lane)
                hits[slot] = state[k + ALPHA]
                hits[slot + HIT_PEAK] = state[k + PEAK]
                hits[slot + HIT_PRECISION] = state[k + PRECISION]
    most = ZERO * state[0]
    for k in range(PLANE):
        most = max(most, state[np.uintp(k) + COUNT])
    return np.int64(most)


@njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def _transmit(state, hits, most, y):
    """Squared transmittance of a row's rays at the depths in plane MEDIAN, as NUM / DEN: one exponential a hit."""
    base, capacity = np.uintp(y * TILE), len(hits) // (TILE * HIT_SIZE)
    for lane in range(TILE):
        k = base + np.uintp(lane)
        state[k + NUM] = ONE
        state[k + DEN] = ONE
    for c in range(most):
        hit = hits[(y * capacity + c) * HIT_SIZE : (y * capacity + c + 1) * HIT_SIZE]
        for lane in range(TILE):
            k = base + np.uintp(lane)
            alpha = hit[np.uintp(lane)]
            alpha = alpha if np.float32(c) < state[k + COUNT] else ZERO
            d = state[k + MEDIAN] - hit[np.uintp(lane) + HIT_PEAK]
            free = ONE - alpha * exp(-HALF * hit[np.uintp(lane) + HIT_PRECISION] * d * d)
            front = d <= ZERO
            state[k + NUM] *= free if front else (ONE - alpha) * (ONE - alpha)
            state[k + DEN] *= ONE if front else free


@njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def _slopes(state, hits, most, y):
    """``-2 d ln T / dt`` of a row's rays at the depths in plane MEDIAN, into plane MEAN."""
    base, capacity = np.uintp(y * TILE), len(hits) // (TILE * HIT_SIZE)
    for lane in range(TILE):
        state[base + np.uintp(lane) + MEAN] = ZERO
    for c in range(most):
        hit = hits[(y * capacity + c) * HIT_SIZE : (y * capacity + c + 1) * HIT_SIZE]
        for lane in range(TILE):
            k = base + np.uintp(lane)
            alpha = hit[np.uintp(lane)]
            alpha = alpha if np.float32(c) < state[k + COUNT] else ZERO
            d = state[k + MEDIAN] - hit[np.uintp(lane) + HIT_PEAK]
            g = alpha * exp(-HALF * hit[np.uintp(lane) + HIT_PRECISION] * d * d)
            state[k + MEAN] += g * hit[np.uintp(lane) + HIT_PRECISION] * abs(d) / (ONE - g)


@njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def _solve_row(state, hits, y, parameters, bisections, newton_steps):
    """Median depth of a row's rays into plane MEDIAN (0: none), its slope S into plane MEAN."""
    median_max, near = parameters[2], parameters[3]
    base, capacity = np.uintp(y * TILE), len(hits) // (TILE * HIT_SIZE)
    most = 0
    for lane in range(TILE):
        k = base + np.uintp(lane)
        if abs(state[k]) >= median_max:
            state[k + COUNT] = ZERO
        most = max(most, np.int64(state[k + COUNT]))
        state[k + LO] = BIG
        state[k + MEDIAN] = ZERO
        if abs(state[k]) > QUARTER:
            state[k + HI] = ZERO
    if most == 0:
        return
    for c in range(most):
        hit = hits[(y * capacity + c) * HIT_SIZE : (y * capacity + c + 1) * HIT_SIZE]
        for lane in range(TILE):
            k = base + np.uintp(lane)
            there = np.float32(c) < state[k + COUNT]
            reach = FOUR / math.sqrt(hit[np.uintp(lane) + HIT_PRECISION])
            lo, hi = hit[np.uintp(lane) + HIT_PEAK] - reach, hit[np.uintp(lane) + HIT_PEAK] + reach
            wide = there & (abs(state[k]) > QUARTER)
            state[k + LO] = min(state[k + LO], lo if there else BIG)
            state[k + HI] = max(state[k + HI], hi if wide else ZERO)
    for lane in range(TILE):
        k = base + np.uintp(lane)
        state[k + LO] = max(state[k + LO], near)
        state[k + MEDIAN] = state[k + LO]
    _transmit(state, hits, most, y)
    for lane in range(TILE):
        k = base + np.uintp(lane)
        if not state[k + NUM] > QUARTER * state[k + DEN]:
            state[k + COUNT] = ZERO
    for _ in range(bisections):
        for lane in range(TILE):
            k = base + np.uintp(lane)
            state[k + MEDIAN] = HALF * (state[k + LO] + state[k + HI])
        _transmit(state, hits, most, y)
        for lane in range(TILE):
            k = base + np.uintp(lane)
            nearer = state[k + NUM] > QUARTER * state[k + DEN]
            lo, middle, hi = state[k + LO], state[k + MEDIAN], state[k + HI]
            state[k + LO] = middle if nearer else lo
            state[k + HI] = hi if nearer else middle
    for lane in range(TILE):
        k = base + np.uintp(lane)
        state[k + MEDIAN] = HALF * (state[k + LO] + state[k + HI])
    for _ in range(newton_steps):
        _transmit(state, hits, most, y)
        _slopes(state, hits, most, y)
        for lane in range(TILE):
            k = base + np.uintp(lane)
            if state[k + MEAN] > ZERO:
                step = math.log(FOUR * state[k + NUM] / state[k + DEN]) / state[k + MEAN]
                state[k + MEDIAN] = min(max(state[k + MEDIAN] + step, state[k + LO]), state[k + HI])
    _slopes(state, hits, most, y)
    for lane in range(TILE):
        k = base + np.uintp(lane)
        state[k + MEAN] *= HALF
        if state[k + COUNT] == ZERO:
            state[k + MEDIAN] = ZERO


@njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def forward_tiles(
    records, boxes, colors, members, starts, tiles, solid, expected, geometry, bisections, newton_steps,
    parameters, background, state, hits, staged, spans, color, normal, depth, slope, transmittance,
):  # fmt: skip
    """Renders the tiles ``tiles[0] .. tiles[1] - 1`` of one view into the images."""
    height, width = depth.shape
    across = -(-width // TILE)
    for tile in range(tiles[0], tiles[1]):
        x_tile, y_tile = (tile % across) * TILE, (tile // across) * TILE
        columns, rows = min(TILE, width - x_tile), min(TILE, height - y_tile)
        mine = members[starts[tile] : starts[tile + 1]]
        room = hits
        while True:
            state[:] = ZERO
            start_rays(state, columns, rows)
            most = _blend_tile(
                records, colors, boxes, mine, x_tile, y_tile, geometry, solid, parameters, state, room, staged, spans
            )
            if most * HIT_SIZE * TILE <= len(room):
                break
            room = np.zeros(TILE * most * HIT_SIZE, hits.dtype)
        for y in range(rows):
            if geometry and solid:
                _solve_row(state, room, y, parameters, bisections, newton_steps)
            for x in range(columns):
                k = np.uintp(y * TILE + x)
                final = abs(state[k])
                row, column = y_tile + y, x_tile + x
                transmittance[row, column] = final
                color[row, column, 0] = state[k + C0] + final * background[0]
                color[row, column, 1] = state[k + C1] + final * background[1]
                color[row, column, 2] = state[k + C2] + final * background[2]
                if geometry:
                    normal[row, column, 0] = state[k + N0]
                    normal[row, column, 1] = state[k + N1]
                    normal[row, column, 2] = state[k + N2]
                    slope[row, column] = state[k + MEAN]
                    if expected:
                        depth[row, column] = state[k + MEAN] / (ONE - final) if final < ONE else ZERO
                    else:
                        depth[row, column] = state[k + MEDIAN]
