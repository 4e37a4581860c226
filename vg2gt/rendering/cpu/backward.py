"""Compiled backward pass over tiles: repeats the forward traversal and writes one gradient row per (tile, Gaussian).

Gradients are polynomials in the pixel's offset (dx, dy) with per-pixel factors, summed per lane over 4 x 4 blocks.
"""

# Written for the compiler: flat bodies; short names follow the formulas in rendering/projection.py.

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vg2gt.kernels.compiled import kernel, kernel_part
from vg2gt.kernels.compiled_math import exp
from vg2gt.rendering.constants import FAST, HALF, ONE, SUMS, TWO, ZERO
from vg2gt.rendering.cpu import planes
from vg2gt.rendering.cpu.tiles import (
    ABSOLUTE_ROW,
    BLOCKS_ACROSS,
    LANE_X,
    LANE_Y,
    LANES,
    ROW,
    SIDE,
    STAGED,
    TILE,
    attenuate,
    lowest_bit,
    place_of,
    respond,
    stage,
    start_rays,
)


@kernel_part(fastmath=FAST, error_model="numpy")
def _load_gradients(
    state, x_tile, y_tile, columns, rows, geometry, color, normal, depth, transmittance,
    grad_color, grad_normal, grad_alpha, grad_solid, grad_expected, grad_crossing,
):  # fmt: skip
    """Loads the incoming gradients; REST is their product with all contributions still ahead on the ray."""
    for y in range(rows):
        for x in range(columns):
            k = place_of(y, x)
            row, column = y_tile + y, x_tile + x
            g0, g1, g2 = grad_color[row, column, 0], grad_color[row, column, 1], grad_color[row, column, 2]
            state[k + planes.G0], state[k + planes.G1], state[k + planes.G2] = g0, g1, g2
            final = transmittance[row, column]
            rest = g0 * color[row, column, 0] + g1 * color[row, column, 1] + g2 * color[row, column, 2]
            rest -= grad_alpha[row, column] * final
            if geometry:
                g3, g4, g5 = grad_normal[row, column, 0], grad_normal[row, column, 1], grad_normal[row, column, 2]
                state[k + planes.G3], state[k + planes.G4], state[k + planes.G5] = g3, g4, g5
                rest += g3 * normal[row, column, 0] + g4 * normal[row, column, 1] + g5 * normal[row, column, 2]
                rest += grad_expected[row, column] * depth[row, column] * (ONE - final)
                state[k + planes.DEPTH] = depth[row, column]
                state[k + planes.KD] = grad_solid[row, column]
                state[k + planes.GE] = grad_expected[row, column]
                state[k + planes.GM] = grad_crossing[row, column]
            state[k + planes.REST] = rest


@kernel_part(fastmath=SUMS, error_model="numpy")
def _reduce_color(sums, g, row):
    """Sums the lanes of one (tile, Gaussian) into its gradient row: the terms of colour and alpha."""
    gx = gxx = gxy = gy = gyy = gs = gsx = gsy = gr = go = k0 = k1 = k2 = ZERO * g[0]
    for lane in range(LANES):
        v = np.uintp(lane)
        gx += sums[planes.AX + v]
        gy += sums[planes.AY + v]
        gxx += sums[planes.AXX + v]
        gxy += sums[planes.AXY + v]
        gyy += sums[planes.AYY + v]
        gs += sums[planes.B + v]
        gsx += sums[planes.BX + v]
        gsy += sums[planes.BY + v]
        gr += sums[planes.GR + v]
        go += sums[planes.GO + v]
        k0 += sums[planes.K0 + v]
        k1 += sums[planes.K1 + v]
        k2 += sums[planes.K2 + v]
    qa, qb, qc, q0, q1, z, a0, eps, opacity = g[2], g[3], g[4], g[5], g[6], g[7], g[8], g[9], g[10]
    row[0] = -TWO * (qa * gx + qb * gy) - gs * q0
    row[1] = -TWO * (qb * gx + qc * gy) - gs * q1
    row[2], row[3], row[4], row[5], row[6] = gxx, TWO * gxy, gyy, gsx, gsy
    row[7], row[8], row[9] = -TWO * gr * eps / z, -gr * eps / a0, go / opacity
    row[10], row[11], row[12] = k0, k1, k2
    row[13], row[14], row[15] = ZERO, ZERO, ZERO


@kernel_part(fastmath=SUMS, error_model="numpy")
def _reduce_geometry(sums, row):
    """Adds the terms of depth and normal to a gradient row."""
    gz = gp = m0 = m1 = m2 = ZERO * row[0]
    for lane in range(LANES):
        v = np.uintp(lane)
        gz += sums[planes.GZ + v]
        gp += sums[planes.GP + v]
        m0 += sums[planes.M0 + v]
        m1 += sums[planes.M1 + v]
        m2 += sums[planes.M2 + v]
    row[7] += gz
    row[8] += gp
    row[13], row[14], row[15] = m0, m1, m2


@kernel_part(fastmath=SUMS, error_model="numpy")
def _reduce_absolute(sums, row):
    """Appends the absolute gradients of the centre to a gradient row."""
    gx = gy = ZERO * row[0]
    for lane in range(LANES):
        v = np.uintp(lane)
        gx += sums[planes.ABS_X + v]
        gy += sums[planes.ABS_Y + v]
    row[ROW], row[ROW + 1] = gx, gy


def _make_backward_tile(geometry: bool, solid: bool, absolute: bool = False) -> Callable[..., None]:
    """Compiles the backward pass of one tile, with its arguments as constants.

    Args:
        geometry: with depth and normals.
        solid: whether they are those of solids.
        absolute: rows end with sums over pixels of absolute gradients of the centre.
    """
    width = ABSOLUTE_ROW if absolute else ROW

    @kernel_part(fastmath=FAST, error_model="numpy")
    def backward_tile(records, colors, members, visits, places, x_tile, y_tile, parameters, state, sums, staged, rows):
        """Visits a tile's Gaussians front to back again and writes the gradient row of each, at its ``places``."""
        alpha_max, stop = parameters[0], parameters[1]
        for p in range(len(members)):
            j = p % STAGED
            if j == 0:
                stage(records, colors, members[p : p + STAGED], staged)
                for q in range(p, min(p + STAGED, len(members))):  # zeroes their rows, which also prefetches them
                    row = rows[places[q]]
                    for i in range(width):
                        row[i] = ZERO
            blocks = np.int64(visits[p])
            if blocks == 0:
                continue
            g = staged[j]
            uc, vc, qa, qb, qc, q0, q1, z = g[0], g[1], g[2], g[3], g[4], g[5], g[6], g[7]
            a0, eps, opacity, cutoff = g[8], g[9], g[10], g[11]
            n0, n1, n2 = g[12], g[13], g[14]
            c0, c1, c2 = g[16], g[17], g[18]
            sums[: planes.ABS_X if geometry else planes.M0] = ZERO
            if absolute:
                sums[planes.ABS_X :] = ZERO
            while blocks:
                block = lowest_bit(blocks)  # pyright: ignore[reportCallIssue]
                blocks &= blocks - 1
                top = np.float32(y_tile + block // BLOCKS_ACROSS * SIDE) - vc
                left = np.float32(x_tile + block % BLOCKS_ACROSS * SIDE) - uc
                base = np.uintp(block * LANES)
                for lane in range(LANES):
                    v = np.uintp(lane)
                    k = base + v
                    # response and alpha, as in the forward pass
                    dx, dy = left + LANE_X[v], top + LANE_Y[v]
                    before = state[k]
                    s_row, e_row, f_row = ONE + q1 * dy, qc * dy * dy, TWO * qb * dy
                    e, s, r, on = respond(dx, (qa, q0, eps, cutoff), s_row, e_row, f_row)
                    r = r if on else ONE
                    inverse = ONE / r
                    exponent = -HALF * e * inverse
                    alpha, after, state[k] = attenuate(exponent, on, before, opacity, alpha_max, stop)
                    kept = alpha > ZERO
                    weight = alpha * before
                    # gradient of alpha: this Gaussian's value against everything behind it
                    g0, g1, g2 = state[k + planes.G0], state[k + planes.G1], state[k + planes.G2]
                    value = g0 * c0 + g1 * c1 + g2 * c2
                    if geometry:
                        peak, precision = z * s * inverse, a0 * r
                        g3, g4, g5 = state[k + planes.G3], state[k + planes.G4], state[k + planes.G5]
                        value = value + g3 * n0 + g4 * n1 + g5 * n2
                        if not solid:
                            toward = state[k + planes.GE]
                            value = value + toward * peak
                    rest = state[k + planes.REST] - weight * (value if kept else ZERO)
                    state[k + planes.REST] = rest
                    free = ONE / (ONE - alpha)
                    slack = before * value - rest * free
                    gt = gp = ZERO
                    if geometry and solid:
                        # implicit gradient of the median (paper, eqn tmed_grad), scaled by kd = incoming / S
                        kd = state[k + planes.KD]
                        d = state[k + planes.DEPTH] - peak
                        bell = exp(-HALF * precision * d * d)
                        gauss = alpha * bell
                        half = HALF * kd / (ONE - gauss)
                        behind = d > ZERO
                        lifted, blocked = half * bell, kd * free
                        slack += lifted - blocked if behind else -lifted
                        pull = half * gauss * abs(d)
                        gt = pull * precision if kept else ZERO
                        gp = -HALF * pull * d if kept else ZERO
                    elif geometry:
                        crossing = (before > HALF) & (after <= HALF)
                        gt = weight * toward + (state[k + planes.GM] if crossing else ZERO)
                        gt = gt if kept else ZERO
                    # chain rule to the response, then sums over the block
                    ga = slack * alpha if (kept & (alpha < alpha_max)) else ZERO
                    gd = -HALF * ga
                    gr = -gd * e * inverse * inverse
                    if geometry:
                        gr = gr - gt * peak * inverse + gp * a0
                    ge = gd * inverse + gr * eps
                    gs = gt * z * inverse + TWO * gr * s if geometry else TWO * gr * s
                    gex, gey = ge * dx, ge * dy
                    if absolute:
                        sums[planes.ABS_X + v] += abs(TWO * (qa * gex + qb * gey) + gs * q0)
                        sums[planes.ABS_Y + v] += abs(TWO * (qb * gex + qc * gey) + gs * q1)
                    sums[planes.AX + v] += gex
                    sums[planes.AY + v] += gey
                    sums[planes.AXX + v] += gex * dx
                    sums[planes.AXY + v] += gex * dy
                    sums[planes.AYY + v] += gey * dy
                    sums[planes.B + v] += gs
                    sums[planes.BX + v] += gs * dx
                    sums[planes.BY + v] += gs * dy
                    sums[planes.GR + v] += gr * e
                    sums[planes.GO + v] += ga
                    sums[planes.K0 + v] += weight * g0
                    sums[planes.K1 + v] += weight * g1
                    sums[planes.K2 + v] += weight * g2
                    if geometry:
                        sums[planes.M0 + v] += weight * g3
                        sums[planes.M1 + v] += weight * g4
                        sums[planes.M2 + v] += weight * g5
                        sums[planes.GZ + v] += gt * s * inverse
                        if solid:
                            sums[planes.GP + v] += gp * r
            row = rows[places[p]]
            _reduce_color(sums, g, row)
            if geometry:
                _reduce_geometry(sums, row)
            if absolute:
                _reduce_absolute(sums, row)

    return backward_tile


# Module globals, not closure variables: numba's cache never finds a kernel whose closure holds another kernel.
_backward_color = _make_backward_tile(False, False)
_backward_rasterized = _make_backward_tile(True, False)
_backward_solid = _make_backward_tile(True, True)
_absolute_color = _make_backward_tile(False, False, True)
_absolute_rasterized = _make_backward_tile(True, False, True)
_absolute_solid = _make_backward_tile(True, True, True)


def _make_backward_tiles(geometry: bool, solid: bool, absolute: bool) -> Callable[..., None]:
    """Compiles the backward pass over tiles of :mod:`vg2gt.rendering.cpu.forward`."""

    @kernel(fastmath=FAST, error_model="numpy", nogil=True)
    def backward_tiles(
        records, colors, members, visits, places, starts, tiles, parameters, state, sums, staged,
        color, normal, depth, transmittance,
        grad_color, grad_normal, grad_alpha, grad_solid, grad_expected, grad_crossing, rows,
    ):  # fmt: skip
        """Writes the gradient rows of tiles ``tiles[0] .. tiles[1] - 1`` of one view."""
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
            args = (
                records, colors, members[begin:end], visits[begin:end], places[begin:end], x_tile, y_tile, parameters,
                state, sums, staged, rows,
            )  # fmt: skip
            if absolute:
                if solid:
                    _absolute_solid(*args)
                elif geometry:
                    _absolute_rasterized(*args)
                else:
                    _absolute_color(*args)
            elif solid:
                _backward_solid(*args)
            elif geometry:
                _backward_rasterized(*args)
            else:
                _backward_color(*args)

    return backward_tiles


BACKWARD = {
    (kind, absolute): _make_backward_tiles(kind != "color", kind == "solid", absolute)
    for kind in ("color", "rasterized", "solid")
    for absolute in (False, True)
}
"""By what is rendered and whether absolute gradients are asked for; compiled at the first call."""
