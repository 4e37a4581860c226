"""Compiled backward pass over tiles: the forward visit again, each (tile, Gaussian) leaving one row of gradients.

Gradients of the screen parameters are polynomials in the pixel's offset (dx, dy) with per-pixel factors; lanes sum the
powers of dy over rows, the powers of dx enter once when the lanes are reduced.
"""

# Written for the compiler: flat bodies, short names from rendering/projection.py's formulas.

from __future__ import annotations

import numpy as np
from numba import njit

from vg2gt.rendering.cpu.tiles import (
    A0,
    A1,
    A2,
    B0,
    B1,
    DEPTH,
    FAST,
    G0,
    G1,
    G2,
    G3,
    G4,
    G5,
    GE,
    GM,
    GO,
    GP,
    GR,
    GZ,
    HALF,
    K0,
    K1,
    K2,
    KD,
    M0,
    M1,
    M2,
    ONE,
    REST,
    ROW,
    STAGED,
    SUMS,
    TILE,
    TWO,
    ZERO,
    any_alive,
    exp,
    stage,
    start_rays,
)


@njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def _load_gradients(
    state, x_tile, y_tile, columns, rows, geometry, color, normal, depth, transmittance,
    grad_color, grad_normal, grad_alpha, grad_solid, grad_expected, grad_crossing,
):  # fmt: skip
    """Fills the planes of the incoming gradients; REST is their product with everything a ray has yet to meet."""
    for y in range(rows):
        for x in range(columns):
            k = np.uintp(y * TILE + x)
            row, column = y_tile + y, x_tile + x
            g0, g1, g2 = grad_color[row, column, 0], grad_color[row, column, 1], grad_color[row, column, 2]
            state[k + G0], state[k + G1], state[k + G2] = g0, g1, g2
            final = transmittance[row, column]
            rest = g0 * color[row, column, 0] + g1 * color[row, column, 1] + g2 * color[row, column, 2]
            rest -= grad_alpha[row, column] * final
            if geometry:
                g3, g4, g5 = grad_normal[row, column, 0], grad_normal[row, column, 1], grad_normal[row, column, 2]
                state[k + G3], state[k + G4], state[k + G5] = g3, g4, g5
                rest += g3 * normal[row, column, 0] + g4 * normal[row, column, 1] + g5 * normal[row, column, 2]
                rest += grad_expected[row, column] * depth[row, column] * (ONE - final)
                state[k + DEPTH] = depth[row, column]
                state[k + KD] = grad_solid[row, column]
                state[k + GE] = grad_expected[row, column]
                state[k + GM] = grad_crossing[row, column]
            state[k + REST] = rest


@njit(fastmath=SUMS, error_model="numpy", nogil=True, cache=True)
def _reduce_color(sums, g, left, row):
    """Sums the lanes of one (tile, Gaussian) into its gradient row, the part that colour and alpha need."""
    gx = gxx = gxy = gy = gyy = gs = gsx = gsy = gr = go = k0 = k1 = k2 = ZERO * left
    for lane in range(TILE):
        v = np.uintp(lane)
        dx = left + np.float32(lane)
        a0, a1, b0 = sums[A0 + v], sums[A1 + v], sums[B0 + v]
        gx += a0 * dx
        gxx += a0 * dx * dx
        gxy += a1 * dx
        gy += a1
        gyy += sums[A2 + v]
        gs += b0
        gsx += b0 * dx
        gsy += sums[B1 + v]
        gr += sums[GR + v]
        go += sums[GO + v]
        k0 += sums[K0 + v]
        k1 += sums[K1 + v]
        k2 += sums[K2 + v]
    qa, qb, qc, q0, q1, z, a0, eps, opacity = g[2], g[3], g[4], g[5], g[6], g[7], g[8], g[9], g[10]
    row[0] = -TWO * (qa * gx + qb * gy) - gs * q0
    row[1] = -TWO * (qb * gx + qc * gy) - gs * q1
    row[2], row[3], row[4], row[5], row[6] = gxx, TWO * gxy, gyy, gsx, gsy
    row[7], row[8], row[9] = -TWO * gr * eps / z, -gr * eps / a0, go / opacity
    row[10], row[11], row[12] = k0, k1, k2
    row[13], row[14], row[15] = ZERO, ZERO, ZERO


@njit(fastmath=SUMS, error_model="numpy", nogil=True, cache=True)
def _reduce_geometry(sums, row):
    """Adds what depth and normal need to a gradient row."""
    gz = gp = m0 = m1 = m2 = ZERO * row[0]
    for lane in range(TILE):
        v = np.uintp(lane)
        gz += sums[GZ + v]
        gp += sums[GP + v]
        m0 += sums[M0 + v]
        m1 += sums[M1 + v]
        m2 += sums[M2 + v]
    row[7] += gz
    row[8] += gp
    row[13], row[14], row[15] = m0, m1, m2


@njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def _backward_tile(
    records, colors, boxes, members, x_tile, y_tile, geometry, parameters, state, sums, staged, spans, rows
):
    """Visits a tile's Gaussians front to back again and writes one gradient row for each."""
    alpha_max, stop = parameters[0], parameters[1]
    visited = len(members)
    for p in range(len(members)):
        j = p % STAGED
        if j == 0:
            if not any_alive(state):
                visited = p
                break
            stage(records, colors, boxes, members[p : p + STAGED], x_tile, y_tile, staged, spans)
        g = staged[j]
        uc, vc, qa, qb, qc, q0, q1, z = g[0], g[1], g[2], g[3], g[4], g[5], g[6], g[7]
        a0, eps, opacity, cutoff = g[8], g[9], g[10], g[11]
        n0, n1, n2 = g[12], g[13], g[14]
        c0, c1, c2 = g[16], g[17], g[18]
        left = np.float32(x_tile) - uc
        sums[:] = ZERO
        for y in range(spans[j, 2], spans[j, 3]):
            dy = np.float32(y_tile + y) - vc
            s_row, e_row, f_row = ONE + q1 * dy, qc * dy * dy, TWO * qb * dy
            base = np.uintp(y * TILE)
            if not geometry:
                for lane in range(TILE):
                    v = np.uintp(lane)
                    k = base + v
                    dx = left + np.float32(lane)
                    e = (qa * dx + f_row) * dx + e_row
                    s = q0 * dx + s_row
                    r = s * s + eps * e
                    before = state[k]
                    on = (e <= cutoff * r) & (s > ZERO) & (before > ZERO)
                    inverse = ONE / (r if on else ONE)
                    full = min(opacity * exp(-HALF * e * inverse), alpha_max)
                    full = full if on else ZERO
                    after = before * (ONE - full)
                    stopped = on & (after < stop)
                    alpha = ZERO if stopped else full
                    state[k] = -before if stopped else after
                    weight = alpha * before
                    g0, g1, g2 = state[k + G0], state[k + G1], state[k + G2]
                    value = g0 * c0 + g1 * c1 + g2 * c2
                    rest = state[k + REST] - weight * value
                    state[k + REST] = rest
                    slack = before * value - rest / (ONE - alpha)
                    ga = slack * alpha if alpha < alpha_max else ZERO
                    gd = -HALF * ga
                    gr = -gd * e * inverse * inverse
                    ge = gd * inverse + gr * eps
                    gs = TWO * gr * s
                    sums[A0 + v] += ge
                    sums[A1 + v] += ge * dy
                    sums[A2 + v] += ge * dy * dy
                    sums[B0 + v] += gs
                    sums[B1 + v] += gs * dy
                    sums[GR + v] += gr * e
                    sums[GO + v] += ga
                    sums[K0 + v] += weight * g0
                    sums[K1 + v] += weight * g1
                    sums[K2 + v] += weight * g2
                continue
            for lane in range(TILE):
                v = np.uintp(lane)
                k = base + v
                dx = left + np.float32(lane)
                e = (qa * dx + f_row) * dx + e_row
                s = q0 * dx + s_row
                r = s * s + eps * e
                before = state[k]
                on = (e <= cutoff * r) & (s > ZERO) & (before > ZERO)
                r = r if on else ONE
                inverse = ONE / r
                full = min(opacity * exp(-HALF * e * inverse), alpha_max)
                full = full if on else ZERO
                after = before * (ONE - full)
                stopped = on & (after < stop)
                alpha = ZERO if stopped else full
                kept = alpha > ZERO
                state[k] = -before if stopped else after
                weight = alpha * before
                peak, precision = z * s * inverse, a0 * r
                g0, g1, g2 = state[k + G0], state[k + G1], state[k + G2]
                g3, g4, g5 = state[k + G3], state[k + G4], state[k + G5]
                toward = state[k + GE]
                value = g0 * c0 + g1 * c1 + g2 * c2 + g3 * n0 + g4 * n1 + g5 * n2 + toward * peak
                rest = state[k + REST] - weight * (value if kept else ZERO)
                state[k + REST] = rest
                free = ONE / (ONE - alpha)
                slack = before * value - rest * free
                # implicit gradient of the median (paper, eqn tmed_grad), scaled by kd = incoming / S
                kd = state[k + KD]
                d = state[k + DEPTH] - peak
                bell = exp(-HALF * precision * d * d)
                gauss = alpha * bell
                half = HALF * kd / (ONE - gauss)
                behind = d > ZERO
                lifted, blocked = half * bell, kd * free
                slack += lifted - blocked if behind else -lifted
                pull = half * gauss * abs(d)
                crossing = (before > HALF) & (after <= HALF)
                to_crossing = state[k + GM]
                gt = pull * precision + weight * toward + (to_crossing if crossing else ZERO)
                gt = gt if kept else ZERO
                gp = -HALF * pull * d if kept else ZERO
                ga = slack * alpha if (kept & (alpha < alpha_max)) else ZERO
                gd = -HALF * ga
                gr = -gd * e * inverse * inverse - gt * peak * inverse + gp * a0
                ge = gd * inverse + gr * eps
                gs = gt * z * inverse + TWO * gr * s
                sums[A0 + v] += ge
                sums[A1 + v] += ge * dy
                sums[A2 + v] += ge * dy * dy
                sums[B0 + v] += gs
                sums[B1 + v] += gs * dy
                sums[GR + v] += gr * e
                sums[GO + v] += ga
                sums[K0 + v] += weight * g0
                sums[K1 + v] += weight * g1
                sums[K2 + v] += weight * g2
                sums[M0 + v] += weight * g3
                sums[M1 + v] += weight * g4
                sums[M2 + v] += weight * g5
                sums[GZ + v] += gt * s * inverse
                sums[GP + v] += gp * r
        row = rows[p]
        _reduce_color(sums, g, left, row)
        if geometry:
            _reduce_geometry(sums, row)
    for p in range(visited, len(members)):
        row = rows[p]
        for j in range(ROW):
            row[j] = ZERO


@njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def backward_tiles(
    records, boxes, colors, members, starts, tiles, geometry, parameters, state, sums, staged, spans,
    color, normal, depth, transmittance,
    grad_color, grad_normal, grad_alpha, grad_solid, grad_expected, grad_crossing, rows,
):  # fmt: skip
    """Gradient rows of the tiles ``tiles[0] .. tiles[1] - 1`` of one view."""
    height, width = transmittance.shape
    across = -(-width // TILE)
    for tile in range(tiles[0], tiles[1]):
        x_tile, y_tile = (tile % across) * TILE, (tile // across) * TILE
        columns, lines = min(TILE, width - x_tile), min(TILE, height - y_tile)
        state[:] = ZERO
        start_rays(state, columns, lines)
        _load_gradients(
            state, x_tile, y_tile, columns, lines, geometry, color, normal, depth, transmittance,
            grad_color, grad_normal, grad_alpha, grad_solid, grad_expected, grad_crossing,
        )  # fmt: skip
        begin, end = starts[tile], starts[tile + 1]
        _backward_tile(
            records, colors, boxes, members[begin:end], x_tile, y_tile, geometry, parameters,
            state, sums, staged, spans, rows[begin:end],
        )  # fmt: skip
