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
from collections.abc import Callable
from typing import Any

import numpy as np

from vg2gt.io.compiled import kernel
from vg2gt.rendering.cpu import planes
from vg2gt.rendering.cpu.constants import BIG, FAST, FOUR, HALF, ONE, QUARTER, TWO, ZERO
from vg2gt.rendering.cpu.response import attenuate, exp, respond
from vg2gt.rendering.cpu.tiles import HIT_SIZE, PLANE, STAGED, TILE, any_alive, stage, start_rays


def _make_blend_tile(geometry: bool) -> Callable[..., Any]:
    """Compiles the blending of a tile with or without depth and normals: within it that is a constant."""

    @kernel(fastmath=FAST, error_model="numpy", nogil=True)
    def blend_tile(records, colors, boxes, members, x_tile, y_tile, solid, parameters, state, hits, staged, spans):
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
                for lane in range(TILE):
                    k = base + np.uintp(lane)
                    dx = left + np.float32(lane)
                    before = state[k]
                    e, s, r, on = respond(dx, before, (qa, q0, eps, cutoff), s_row, e_row, f_row)
                    if geometry:
                        r = r if on else ONE
                        inverse = ONE / r
                        exponent = -HALF * e * inverse
                    else:
                        exponent = -HALF * e / r
                    alpha, after, state[k] = attenuate(exponent, on, before, opacity, alpha_max, stop)
                    weight = alpha * before  # paper, eqn 3dgs_render_preliminary
                    state[k + planes.C0] += weight * c0
                    state[k + planes.C1] += weight * c1
                    state[k + planes.C2] += weight * c2
                    if geometry:
                        peak, precision = z * s * inverse, a0 * r
                        state[k + planes.N0] += weight * n0
                        state[k + planes.N1] += weight * n1
                        state[k + planes.N2] += weight * n2
                        state[k + planes.MEAN] += weight * peak
                        crossing = (alpha > ZERO) & (before > HALF) & (after <= HALF)
                        median = state[k + planes.MEDIAN]
                        state[k + planes.MEDIAN] = peak if crossing else median
                        state[k + planes.ALPHA] = alpha
                        state[k + planes.PEAK] = peak
                        state[k + planes.PRECISION] = precision
                        # the median is in front of HI: a hit that begins far behind does not matter to it
                        early = before > QUARTER
                        hi = state[k + planes.HI]
                        hi = max(hi, peak if early & (alpha > ZERO) else ZERO)
                        state[k + planes.HI] = hi
                        beyond = peak - hi
                        near_enough = (beyond <= ZERO) | (precision * beyond * beyond <= negligible)
                        matters = (alpha > ZERO) & (early | near_enough)
                        slot = state[k + planes.COUNT]
                        state[k + planes.SLOT] = slot
                        state[k + planes.COUNT] = slot + (ONE if matters else ZERO)
            if not (geometry and solid):
                continue
            for y in range(top, bottom):  # a loop of its own: reading what was just written as a vector would stall
                base = np.uintp(y * TILE)
                for lane in range(first, last):  # no branch: what does not matter is overwritten by the next hit
                    k = base + np.uintp(lane)
                    slot = min(np.int32(state[k + planes.SLOT]), last_slot) + y * capacity
                    place = np.uintp(slot) * planes.HIT + np.uintp(lane)
                    hits[place] = state[k + planes.ALPHA]
                    hits[place + planes.HIT_PEAK] = state[k + planes.PEAK]
                    hits[place + planes.HIT_PRECISION] = state[k + planes.PRECISION]
        most = ZERO * state[0]
        for k in range(PLANE):
            most = max(most, state[np.uintp(k) + planes.COUNT])
        return np.int64(most)

    return blend_tile


_blend_all, _blend_color = _make_blend_tile(True), _make_blend_tile(False)


@kernel(fastmath=FAST, error_model="numpy", nogil=True)
def _transmit(state, hits, most, y):
    """Squared transmittance of a row's rays at the depths in plane MEDIAN, as NUM / DEN: one exponential per hit."""
    base, capacity = np.uintp(y * TILE), len(hits) // (TILE * HIT_SIZE)
    for lane in range(TILE):
        k = base + np.uintp(lane)
        state[k + planes.NUM] = ONE
        state[k + planes.DEN] = ONE
    for c in range(most):
        hit = hits[(y * capacity + c) * HIT_SIZE : (y * capacity + c + 1) * HIT_SIZE]
        for lane in range(TILE):
            k = base + np.uintp(lane)
            alpha = hit[np.uintp(lane)]
            alpha = alpha if np.float32(c) < state[k + planes.COUNT] else ZERO
            d = state[k + planes.MEDIAN] - hit[np.uintp(lane) + planes.HIT_PEAK]
            free = ONE - alpha * exp(-HALF * hit[np.uintp(lane) + planes.HIT_PRECISION] * d * d)
            front = d <= ZERO
            state[k + planes.NUM] *= free if front else (ONE - alpha) * (ONE - alpha)
            state[k + planes.DEN] *= ONE if front else free


@kernel(fastmath=FAST, error_model="numpy", nogil=True)
def _slopes(state, hits, most, y):
    """``-2 d ln T / dt`` of a row's rays at the depths in plane MEDIAN, into plane MEAN."""
    base, capacity = np.uintp(y * TILE), len(hits) // (TILE * HIT_SIZE)
    for lane in range(TILE):
        state[base + np.uintp(lane) + planes.MEAN] = ZERO
    for c in range(most):
        hit = hits[(y * capacity + c) * HIT_SIZE : (y * capacity + c + 1) * HIT_SIZE]
        for lane in range(TILE):
            k = base + np.uintp(lane)
            alpha = hit[np.uintp(lane)]
            alpha = alpha if np.float32(c) < state[k + planes.COUNT] else ZERO
            d = state[k + planes.MEDIAN] - hit[np.uintp(lane) + planes.HIT_PEAK]
            g = alpha * exp(-HALF * hit[np.uintp(lane) + planes.HIT_PRECISION] * d * d)
            state[k + planes.MEAN] += g * hit[np.uintp(lane) + planes.HIT_PRECISION] * abs(d) / (ONE - g)


@kernel(fastmath=FAST, error_model="numpy", nogil=True)
def _solve_row(state, hits, y, parameters, bisections, newton_steps):
    """Median depth of a row's rays into plane MEDIAN (0: none), its slope S into plane MEAN."""
    median_max, near = parameters[2], parameters[3]
    base, capacity = np.uintp(y * TILE), len(hits) // (TILE * HIT_SIZE)
    most = 0
    for lane in range(TILE):
        k = base + np.uintp(lane)
        if abs(state[k]) >= median_max:
            state[k + planes.COUNT] = ZERO
        most = max(most, np.int64(state[k + planes.COUNT]))
        state[k + planes.LO] = BIG
        state[k + planes.MEDIAN] = ZERO
        if abs(state[k]) > QUARTER:
            state[k + planes.HI] = ZERO
    if most == 0:
        return
    for c in range(most):
        hit = hits[(y * capacity + c) * HIT_SIZE : (y * capacity + c + 1) * HIT_SIZE]
        for lane in range(TILE):
            k = base + np.uintp(lane)
            there = np.float32(c) < state[k + planes.COUNT]
            reach = FOUR / math.sqrt(hit[np.uintp(lane) + planes.HIT_PRECISION])
            lo, hi = hit[np.uintp(lane) + planes.HIT_PEAK] - reach, hit[np.uintp(lane) + planes.HIT_PEAK] + reach
            wide = there & (abs(state[k]) > QUARTER)
            state[k + planes.LO] = min(state[k + planes.LO], lo if there else BIG)
            state[k + planes.HI] = max(state[k + planes.HI], hi if wide else ZERO)
    for lane in range(TILE):
        k = base + np.uintp(lane)
        state[k + planes.LO] = max(state[k + planes.LO], near)
        state[k + planes.MEDIAN] = state[k + planes.LO]
    _transmit(state, hits, most, y)
    for lane in range(TILE):
        k = base + np.uintp(lane)
        if not state[k + planes.NUM] > QUARTER * state[k + planes.DEN]:
            state[k + planes.COUNT] = ZERO
    for _ in range(bisections):
        for lane in range(TILE):
            k = base + np.uintp(lane)
            state[k + planes.MEDIAN] = HALF * (state[k + planes.LO] + state[k + planes.HI])
        _transmit(state, hits, most, y)
        for lane in range(TILE):
            k = base + np.uintp(lane)
            nearer = state[k + planes.NUM] > QUARTER * state[k + planes.DEN]
            lo, middle, hi = state[k + planes.LO], state[k + planes.MEDIAN], state[k + planes.HI]
            state[k + planes.LO] = middle if nearer else lo
            state[k + planes.HI] = hi if nearer else middle
    for lane in range(TILE):
        k = base + np.uintp(lane)
        state[k + planes.MEDIAN] = HALF * (state[k + planes.LO] + state[k + planes.HI])
    for _ in range(newton_steps):
        _transmit(state, hits, most, y)
        _slopes(state, hits, most, y)
        for lane in range(TILE):
            k = base + np.uintp(lane)
            if state[k + planes.MEAN] > ZERO:
                step = math.log(FOUR * state[k + planes.NUM] / state[k + planes.DEN]) / state[k + planes.MEAN]
                state[k + planes.MEDIAN] = min(
                    max(state[k + planes.MEDIAN] + step, state[k + planes.LO]), state[k + planes.HI]
                )
    _slopes(state, hits, most, y)
    for lane in range(TILE):
        k = base + np.uintp(lane)
        state[k + planes.MEAN] *= HALF
        if state[k + planes.COUNT] == ZERO:
            state[k + planes.MEDIAN] = ZERO


@kernel(fastmath=FAST, error_model="numpy", nogil=True)
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
            given = (records, colors, boxes, mine, x_tile, y_tile, solid, parameters, state, room, staged, spans)
            most = _blend_all(*given) if geometry else _blend_color(*given)
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
                color[row, column, 0] = state[k + planes.C0] + final * background[0]
                color[row, column, 1] = state[k + planes.C1] + final * background[1]
                color[row, column, 2] = state[k + planes.C2] + final * background[2]
                if geometry:
                    normal[row, column, 0] = state[k + planes.N0]
                    normal[row, column, 1] = state[k + planes.N1]
                    normal[row, column, 2] = state[k + planes.N2]
                    slope[row, column] = state[k + planes.MEAN]
                    if expected:
                        depth[row, column] = state[k + planes.MEAN] / (ONE - final) if final < ONE else ZERO
                    else:
                        depth[row, column] = state[k + planes.MEDIAN]
