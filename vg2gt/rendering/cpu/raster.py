"""Compiled tile rasteriser, forward and backward.

A tile is 16 x 16 pixels. Its Gaussians are visited front to back; each touches the rows of its exact box, and a row of 16
pixels is one vector operation: the innermost loops have a fixed length and no branch, so that they vectorise. All state of
a tile lies in planes of one flat scratch array, whose offsets are constants: with several arrays the compiler would have to
guard every loop against overlap. Rays are stopped by the sign of their transmittance.

Kernels are generic in the dtype: constants exact in float32 do not change the type they meet, others come in as an array.
They are kept in one file because the compiler's cache follows changes of the file that defines a kernel only.
"""

# The kernels are written for the compiler: one flat body each, short names from rendering/projection.py's formulas.

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic, overload

TILE = 16
RECORD = 16  # projected Gaussian: centre 2, conic 3, tilt 2, z, a0, eps, opacity, cutoff, normal 3, unused
ROW = 16  # gradient of one (tile, Gaussian): centre 2, conic 3, tilt 2, z, a0, opacity, colour 3, normal 3
PLANES = 16  # of TILE * TILE values, then LANE_ROWS rows of TILE values
LANE_ROWS = 16
SCRATCH = PLANES * TILE * TILE + LANE_ROWS * TILE
HIT = 3  # alpha, peak, precision
PARAMETERS = ("alpha_max", "stop", "median_max", "near", "negligible")

ZERO, HALF, ONE, TWO, FOUR, QUARTER = (np.float32(value) for value in (0, 0.5, 1, 2, 4, 0.25))
BIG = np.float32(2.0**100)
FAST: Any = {"contract", "nsz", "arcp"}  # nothing that reorders sums or assumes finite values
SUMS: Any = {"contract", "nsz", "arcp", "reassoc"}
PLANE = TILE * TILE
# planes; forward and backward use the same memory
T_, C0, C1, C2, N0, N1, N2, MEDIAN, MEAN, HI, LO, NUM, DEN, COUNT = (np.uintp(j * PLANE) for j in range(14))
REST, G0, G1, G2, G3, G4, G5, DEPTH, KD, GE, GM = (np.uintp(j * PLANE) for j in range(1, 12))
LANES = np.uintp(PLANES * PLANE)
ROW_ALPHA, ROW_PEAK, ROW_PRECISION, ROW_BEFORE = (np.uintp(PLANES * PLANE + j * TILE) for j in range(4))
(A0, A1, A2, B0, B1, GR, GO, K0, K1, K2, M0, M1, M2, GZ, GP) = (np.uintp(PLANES * PLANE + j * TILE) for j in range(15))

LOG2E = np.float32(1.4426950408889634)
LN2_HIGH, LN2_LOW = np.float32(0.693359375), np.float32(-2.12194440e-4)
EXP2_BIAS, EXP2_SHIFT = np.int32(127), np.int32(23)
UNDERFLOW = np.float32(-87.0)
E6, E5, E4, E3, E2 = (np.float32(1 / math.factorial(n)) for n in (6, 5, 4, 3, 2))


@intrinsic
def _float32_of_bits(typing_context, bits):  # noqa: ANN001
    def codegen(context, builder, signature, args):  # noqa: ANN001
        return builder.bitcast(args[0], ir.FloatType())

    return types.float32(types.int32), codegen


def _exp(x: Any) -> Any:
    """Exponential of a number <= 0: vectorising in float32 (relative error 2e-7), the library's in float64."""
    raise NotImplementedError("compiled code only")


@overload(_exp, jit_options={"fastmath": {"contract", "nsz", "arcp", "nnan"}, "error_model": "numpy"})
def _exp_overload(x):  # noqa: ANN001
    if x == types.float64:
        return lambda x: math.exp(x)

    def exp32(x):  # noqa: ANN001
        x = max(x, UNDERFLOW)
        n = np.floor(x * LOG2E + HALF)
        f = x - n * LN2_HIGH
        f = f - n * LN2_LOW
        p = ((((E6 * f + E5) * f + E4) * f + E3) * f + E2) * f * f + f + ONE
        return p * _float32_of_bits((np.int32(n) + EXP2_BIAS) << EXP2_SHIFT)

    return exp32


@njit(fastmath=SUMS, error_model="numpy", nogil=True, cache=True)
def _any_alive(state):
    most = state[0]
    for k in range(PLANE):
        most = max(most, state[k])
    return most > ZERO


@njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def _start_rays(state, columns, rows):
    """Transmittance 1 in the image's pixels, stopped rays beyond its border."""
    for y in range(TILE):
        for x in range(TILE):
            state[np.uintp(y * TILE + x)] = ONE if (y < rows and x < columns) else -ONE


@njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def _blend_tile(records, colors, boxes, members, x_tile, y_tile, geometry, solid, parameters, state, hits, counts):
    """Blends one tile front to back; returns the largest number of hits kept for the depth solver."""
    alpha_max, stop, negligible = parameters[0], parameters[1], parameters[4]
    capacity = hits.shape[1]
    most = 0
    for p in range(len(members)):
        if p % 8 == 7 and not _any_alive(state):
            break
        i = np.uintp(members[p])
        g = records[i]
        uc, vc, qa, qb, qc, q0, q1, z = g[0], g[1], g[2], g[3], g[4], g[5], g[6], g[7]
        a0, eps, opacity, cutoff = g[8], g[9], g[10], g[11]
        n0, n1, n2 = g[12], g[13], g[14]
        c0, c1, c2 = colors[i, 0], colors[i, 1], colors[i, 2]
        left = np.float32(x_tile) - uc
        first = max(boxes[i, 0] - x_tile, 0)
        last = min(boxes[i, 1] - x_tile, TILE)
        for y in range(max(boxes[i, 2] - y_tile, 0), min(boxes[i, 3] - y_tile, TILE)):
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
                    alpha = min(opacity * _exp(-HALF * e / r), alpha_max)
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
                inverse = ONE / r
                alpha = min(opacity * _exp(-HALF * e * inverse), alpha_max)
                alpha = alpha if on else ZERO
                after = before * (ONE - alpha)
                stopped = on & (after < stop)
                alpha = ZERO if stopped else alpha
                weight = alpha * before
                peak = z * s * inverse
                state[k] = -before if stopped else after
                state[k + C0] += weight * c0
                state[k + C1] += weight * c1
                state[k + C2] += weight * c2
                state[k + N0] += weight * n0
                state[k + N1] += weight * n1
                state[k + N2] += weight * n2
                state[k + MEAN] += weight * (peak if on else ZERO)
                crossing = (alpha > ZERO) & (before > HALF) & (after <= HALF)
                state[k + MEDIAN] = peak if crossing else state[k + MEDIAN]
                state[ROW_ALPHA + np.uintp(lane)] = alpha
                state[ROW_PEAK + np.uintp(lane)] = peak
                state[ROW_PRECISION + np.uintp(lane)] = a0 * r
                state[ROW_BEFORE + np.uintp(lane)] = before
            if not solid:
                continue
            for lane in range(first, last):
                v = np.uintp(lane)
                alpha = state[ROW_ALPHA + v]
                if alpha == ZERO:
                    continue
                k = base + v
                peak, precision = state[ROW_PEAK + v], state[ROW_PRECISION + v]
                if state[ROW_BEFORE + v] > QUARTER:
                    state[k + HI] = max(state[k + HI], peak)
                else:  # the median is in front of HI: what begins far behind does not matter
                    beyond = peak - state[k + HI]
                    if beyond > ZERO and precision * beyond * beyond > negligible:
                        continue
                c = counts[k]
                if c < capacity:
                    hit = hits[y, c]
                    hit[0, lane] = alpha
                    hit[1, lane] = peak
                    hit[2, lane] = precision
                c += 1
                counts[k] = c
                most = max(most, c)
    return most


@njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def _transmit(state, hits, most, y):
    """Squared transmittance of a row's rays at the depths in plane MEDIAN, as NUM / DEN: one exponential a hit."""
    base = np.uintp(y * TILE)
    for lane in range(TILE):
        k = base + np.uintp(lane)
        state[k + NUM] = ONE
        state[k + DEN] = ONE
    for c in range(most):
        hit = hits[y, c]
        for lane in range(TILE):
            k = base + np.uintp(lane)
            alpha = hit[0, lane] if np.float32(c) < state[k + COUNT] else ZERO
            d = state[k + MEDIAN] - hit[1, lane]
            free = ONE - alpha * _exp(-HALF * hit[2, lane] * d * d)
            front = d <= ZERO
            state[k + NUM] *= free if front else (ONE - alpha) * (ONE - alpha)
            state[k + DEN] *= ONE if front else free


@njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def _slopes(state, hits, most, y):
    """``-2 d ln T / dt`` of a row's rays at the depths in plane MEDIAN, into plane MEAN."""
    base = np.uintp(y * TILE)
    for lane in range(TILE):
        state[base + np.uintp(lane) + MEAN] = ZERO
    for c in range(most):
        hit = hits[y, c]
        for lane in range(TILE):
            k = base + np.uintp(lane)
            alpha = hit[0, lane] if np.float32(c) < state[k + COUNT] else ZERO
            d = state[k + MEDIAN] - hit[1, lane]
            g = alpha * _exp(-HALF * hit[2, lane] * d * d)
            state[k + MEAN] += g * hit[2, lane] * abs(d) / (ONE - g)


@njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def _solve_row(state, hits, counts, y, parameters, bisections, newton_steps):
    """Median depth of a row's rays into plane MEDIAN (0: none), its slope S into plane MEAN."""
    median_max, near = parameters[2], parameters[3]
    base = np.uintp(y * TILE)
    most = 0
    for lane in range(TILE):
        k = base + np.uintp(lane)
        if abs(state[k]) >= median_max:
            counts[k] = 0
        most = max(most, counts[k])
        state[k + COUNT] = np.float32(counts[k])
        state[k + LO] = BIG
        state[k + MEDIAN] = ZERO
        if abs(state[k]) > QUARTER:
            state[k + HI] = ZERO
    if most == 0:
        return
    for c in range(most):
        hit = hits[y, c]
        for lane in range(TILE):
            k = base + np.uintp(lane)
            there = np.float32(c) < state[k + COUNT]
            reach = FOUR / math.sqrt(hit[2, lane])
            lo, hi = hit[1, lane] - reach, hit[1, lane] + reach
            state[k + LO] = min(state[k + LO], lo) if there else state[k + LO]
            wide = there & (abs(state[k]) > QUARTER)
            state[k + HI] = max(state[k + HI], hi) if wide else state[k + HI]
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
            middle = state[k + MEDIAN]
            state[k + LO] = middle if nearer else state[k + LO]
            state[k + HI] = state[k + HI] if nearer else middle
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
    parameters, background, state, hits, color, normal, depth, slope, transmittance,
):  # fmt: skip
    """Renders the tiles ``tiles[0] .. tiles[1] - 1`` of one view into the images."""
    height, width = depth.shape
    across = -(-width // TILE)
    counts = np.zeros(PLANE, np.int64)
    for tile in range(tiles[0], tiles[1]):
        x_tile, y_tile = (tile % across) * TILE, (tile // across) * TILE
        columns, rows = min(TILE, width - x_tile), min(TILE, height - y_tile)
        mine = members[starts[tile] : starts[tile + 1]]
        room = hits
        while True:
            state[:] = ZERO
            counts[:] = 0
            _start_rays(state, columns, rows)
            most = _blend_tile(
                records, colors, boxes, mine, x_tile, y_tile, geometry, solid, parameters, state, room, counts
            )
            if most <= room.shape[1]:
                break
            room = np.zeros((TILE, most, HIT, TILE), hits.dtype)
        for y in range(rows):
            if geometry and solid:
                _solve_row(state, room, counts, y, parameters, bisections, newton_steps)
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
def _reduce_color(state, g, left, row):
    """Sums the lanes of one (tile, Gaussian) into its gradient row, the part that colour and alpha need."""
    gx = gxx = gxy = gy = gyy = gs = gsx = gsy = gr = go = k0 = k1 = k2 = ZERO * left
    for lane in range(TILE):
        v = np.uintp(lane)
        dx = left + np.float32(lane)
        a0, a1, b0 = state[A0 + v], state[A1 + v], state[B0 + v]
        gx += a0 * dx
        gxx += a0 * dx * dx
        gxy += a1 * dx
        gy += a1
        gyy += state[A2 + v]
        gs += b0
        gsx += b0 * dx
        gsy += state[B1 + v]
        gr += state[GR + v]
        go += state[GO + v]
        k0 += state[K0 + v]
        k1 += state[K1 + v]
        k2 += state[K2 + v]
    qa, qb, qc, q0, q1, z, a0, eps, opacity = g[2], g[3], g[4], g[5], g[6], g[7], g[8], g[9], g[10]
    row[0] = -TWO * (qa * gx + qb * gy) - gs * q0
    row[1] = -TWO * (qb * gx + qc * gy) - gs * q1
    row[2], row[3], row[4], row[5], row[6] = gxx, TWO * gxy, gyy, gsx, gsy
    row[7], row[8], row[9] = -TWO * gr * eps / z, -gr * eps / a0, go / opacity
    row[10], row[11], row[12] = k0, k1, k2
    row[13], row[14], row[15] = ZERO, ZERO, ZERO


@njit(fastmath=SUMS, error_model="numpy", nogil=True, cache=True)
def _reduce_geometry(state, row):
    """Adds what depth and normal need to a gradient row."""
    gz = gp = m0 = m1 = m2 = ZERO * row[0]
    for lane in range(TILE):
        v = np.uintp(lane)
        gz += state[GZ + v]
        gp += state[GP + v]
        m0 += state[M0 + v]
        m1 += state[M1 + v]
        m2 += state[M2 + v]
    row[7] += gz
    row[8] += gp
    row[13], row[14], row[15] = m0, m1, m2


@njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def _backward_tile(records, colors, boxes, members, slots, x_tile, y_tile, geometry, parameters, state, rows):
    """Visits a tile's Gaussians front to back again and writes one gradient row for each."""
    alpha_max, stop = parameters[0], parameters[1]
    visited = len(members)
    for p in range(len(members)):
        if p % 8 == 7 and not _any_alive(state):
            visited = p
            break
        i = np.uintp(members[p])
        g = records[i]
        uc, vc, qa, qb, qc, q0, q1, z = g[0], g[1], g[2], g[3], g[4], g[5], g[6], g[7]
        a0, eps, opacity, cutoff = g[8], g[9], g[10], g[11]
        n0, n1, n2 = g[12], g[13], g[14]
        c0, c1, c2 = colors[i, 0], colors[i, 1], colors[i, 2]
        left = np.float32(x_tile) - uc
        for lane in range(LANE_ROWS * TILE):
            state[LANES + np.uintp(lane)] = ZERO
        for y in range(max(boxes[i, 2] - y_tile, 0), min(boxes[i, 3] - y_tile, TILE)):
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
                    full = min(opacity * _exp(-HALF * e * inverse), alpha_max)
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
                    state[A0 + v] += ge
                    state[A1 + v] += ge * dy
                    state[A2 + v] += ge * dy * dy
                    state[B0 + v] += gs
                    state[B1 + v] += gs * dy
                    state[GR + v] += gr * e
                    state[GO + v] += ga
                    state[K0 + v] += weight * g0
                    state[K1 + v] += weight * g1
                    state[K2 + v] += weight * g2
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
                full = min(opacity * _exp(-HALF * e * inverse), alpha_max)
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
                bell = _exp(-HALF * precision * d * d)
                gauss = alpha * bell
                half = HALF * kd / (ONE - gauss)
                behind = d > ZERO
                slack += half * bell - kd * free if behind else -half * bell
                pull = half * gauss * abs(d)
                crossing = (before > HALF) & (after <= HALF)
                gt = pull * precision + weight * toward + (state[k + GM] if crossing else ZERO)
                gt = gt if kept else ZERO
                gp = -HALF * pull * d if kept else ZERO
                ga = slack * alpha if (kept & (alpha < alpha_max)) else ZERO
                gd = -HALF * ga
                gr = -gd * e * inverse * inverse - gt * peak * inverse + gp * a0
                ge = gd * inverse + gr * eps
                gs = gt * z * inverse + TWO * gr * s
                state[A0 + v] += ge
                state[A1 + v] += ge * dy
                state[A2 + v] += ge * dy * dy
                state[B0 + v] += gs
                state[B1 + v] += gs * dy
                state[GR + v] += gr * e
                state[GO + v] += ga
                state[K0 + v] += weight * g0
                state[K1 + v] += weight * g1
                state[K2 + v] += weight * g2
                state[M0 + v] += weight * g3
                state[M1 + v] += weight * g4
                state[M2 + v] += weight * g5
                state[GZ + v] += gt * s * inverse
                state[GP + v] += gp * r
        row = rows[slots[p]]
        _reduce_color(state, g, left, row)
        if geometry:
            _reduce_geometry(state, row)
    for p in range(visited, len(members)):
        row = rows[slots[p]]
        for j in range(ROW):
            row[j] = ZERO


@njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def backward_tiles(
    records, boxes, colors, members, slots, starts, tiles, geometry, parameters, state,
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
        _start_rays(state, columns, lines)
        _load_gradients(
            state, x_tile, y_tile, columns, lines, geometry, color, normal, depth, transmittance,
            grad_color, grad_normal, grad_alpha, grad_solid, grad_expected, grad_crossing,
        )  # fmt: skip
        begin, end = starts[tile], starts[tile + 1]
        _backward_tile(
            records,
            colors,
            boxes,
            members[begin:end],
            slots[begin:end],
            x_tile,
            y_tile,
            geometry,
            parameters,
            state,
            rows,
        )
