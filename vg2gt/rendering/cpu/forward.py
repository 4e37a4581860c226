"""Compiled forward pass over tiles of 16 x 16 pixels.

A tile's Gaussians are visited front to back. Each touches some of the tile's blocks of 4 x 4 pixels; a block is one
vector operation. The state of a tile lies in planes of one flat scratch array, whose constant offsets let the compiler
vectorise. A stopped ray has a negative transmittance. For the median depth, every ray stores its own hits; entry n of
a block holds the n-th hit of each of its 16 rays. Kernels are generic in the dtype: constants that are exact in float32
do not change the dtype of results; all others are passed in an array.
"""

# Written for the compiler: flat bodies; short names follow the formulas in rendering/projection.py.

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from vg2gt.kernels.compiled import kernel, kernel_part
from vg2gt.kernels.compiled_math import exp
from vg2gt.rendering.constants import BIG, FAST, FOUR, HALF, ONE, QUARTER, TWO, ZERO
from vg2gt.rendering.cpu import planes
from vg2gt.rendering.cpu.tiles import (
    BLOCKS,
    BLOCKS_ACROSS,
    HIT_SIZE,
    LANE_X,
    LANE_Y,
    LANES,
    PLANE,
    SIDE,
    STAGED,
    TILE,
    alive_blocks,
    attenuate,
    find_blocks,
    lowest_bit,
    place_of,
    positive_lanes,
    respond,
    stage,
    start_rays,
)


@kernel_part(fastmath=FAST, error_model="numpy")
def _first_entry(hits, block):
    """Returns where a block's entries begin, and how many there is room for; entry 0 of all is the Gaussian at hand."""
    capacity = (len(hits) // HIT_SIZE - 1) // BLOCKS
    return 1 + block * capacity, capacity


@kernel_part(fastmath=FAST, error_model="numpy")
def _append(hits, counts, block):
    """Copies the hits in entry 0 to the ends of their rays' lists."""
    first, capacity = _first_entry(hits, block)
    lanes = positive_lanes(hits, np.uintp(0))  # pyright: ignore[reportCallIssue]
    while lanes:
        lane = np.uintp(lowest_bit(lanes))  # pyright: ignore[reportCallIssue]
        lanes &= lanes - 1
        ray = np.uintp(block * LANES) + lane
        to = np.uintp((first + min(counts[ray], capacity - 1)) * HIT_SIZE) + lane
        hits[to] = hits[lane]
        hits[to + planes.HIT_PEAK] = hits[lane + planes.HIT_PEAK]
        hits[to + planes.HIT_PRECISION] = hits[lane + planes.HIT_PRECISION]
        counts[ray] += 1


@kernel_part(fastmath=FAST, error_model="numpy")
def _fill_up(hits, counts, block):
    """Gives all rays of a block the same even number of entries, of opacity 0 where they have none; returns it."""
    first, _ = _first_entry(hits, block)
    most = 0
    for lane in range(LANES):
        most = max(most, counts[block * LANES + lane])
    most += most % 2
    for lane in range(LANES):
        for c in range(counts[block * LANES + lane], most):
            hits[(first + c) * HIT_SIZE + lane] = ZERO
    return first, most


def _make_blend_tile(geometry: bool, solid: bool) -> Callable[..., Any]:
    """Compiles the blending of one tile; ``geometry`` (depth and normals) and ``solid`` are constants in it."""

    @kernel_part(fastmath=FAST, error_model="numpy")
    def blend_tile(
        records, colors, boxes, members, visits, x_tile, y_tile, parameters, state, hits, counts, staged, touched
    ):
        """Blends one tile front to back.

        ``counts`` receives each ray's number of hits for the depth solver, ``visits`` a bit mask of the blocks that
        each Gaussian changes, for the backward pass.
        """
        alpha_max, stop, negligible = parameters[0], parameters[1], parameters[4]
        alive = 0
        for p in range(len(members)):
            j = p % STAGED
            if j == 0:
                alive = alive_blocks(state)
                if not alive:
                    break
                stage(records, colors, members[p : p + STAGED], staged)
                find_blocks(boxes, members[p : p + STAGED], x_tile, y_tile, touched)
            g = staged[j]
            uc, vc, qa, qb, qc, q0, q1, z = g[0], g[1], g[2], g[3], g[4], g[5], g[6], g[7]
            a0, eps, opacity, cutoff = g[8], g[9], g[10], g[11]
            n0, n1, n2 = g[12], g[13], g[14]
            c0, c1, c2 = g[16], g[17], g[18]
            blocks = touched[j] & alive
            changed = 0
            while blocks:
                block = lowest_bit(blocks)  # pyright: ignore[reportCallIssue]
                blocks &= blocks - 1
                top = np.float32(y_tile + block // BLOCKS_ACROSS * SIDE) - vc
                left = np.float32(x_tile + block % BLOCKS_ACROSS * SIDE) - uc
                base = np.uintp(block * LANES)
                hit = False
                for lane in range(LANES):
                    v = np.uintp(lane)
                    k = base + v
                    dx, dy = left + LANE_X[v], top + LANE_Y[v]
                    before = state[k]
                    s_row, e_row, f_row = ONE + q1 * dy, qc * dy * dy, TWO * qb * dy
                    e, s, r, on = respond(dx, (qa, q0, eps, cutoff), s_row, e_row, f_row)
                    hit |= on & (before > ZERO)
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
                        peak = z * s * inverse
                        state[k + planes.N0] += weight * n0
                        state[k + planes.N1] += weight * n1
                        state[k + planes.N2] += weight * n2
                        crossing = (alpha > ZERO) & (before > HALF) & (after <= HALF)
                        median = state[k + planes.MEDIAN]
                        state[k + planes.MEDIAN] = peak if crossing else median
                        if solid:
                            precision = a0 * r
                            lo, thin = state[k + planes.LO], state[k + planes.THIN]
                            state[k + planes.LO] = min(lo, peak if alpha > ZERO else BIG)
                            state[k + planes.THIN] = min(thin, precision if alpha > ZERO else BIG)
                            # the median is in front of HI: a hit that begins far behind HI does not affect it
                            early = before > QUARTER
                            hi = state[k + planes.HI]
                            hi = max(hi, peak if early & (alpha > ZERO) else ZERO)
                            state[k + planes.HI] = hi
                            beyond = peak - hi
                            near_enough = (beyond <= ZERO) | (precision * beyond * beyond <= negligible)
                            matters = (alpha > ZERO) & (early | near_enough)
                            hits[v] = alpha if matters else ZERO
                            hits[v + planes.HIT_PEAK] = peak
                            hits[v + planes.HIT_PRECISION] = precision
                        else:
                            state[k + planes.MEAN] += weight * peak
                if solid:
                    _append(hits, counts, block)
                changed |= np.int64(hit) << block
            visits[p] = changed

    return blend_tile


@kernel_part(fastmath=FAST, error_model="numpy", forceinline=True)
def _pass_hit(hit, lane, t, num, den, slope):
    """Multiplies one hit into T^2 = num / den at depth t, and adds it to the slope ``-d ln T^2 / dt``."""
    alpha, precision = hit[lane], hit[lane + planes.HIT_PRECISION]
    d = t - hit[lane + planes.HIT_PEAK]
    g = alpha * exp(-HALF * precision * d * d)
    free = ONE - g
    front = d <= ZERO
    num *= free if front else (ONE - alpha) * (ONE - alpha)
    den *= ONE if front else free
    return num, den, slope + g * precision * abs(d) / free


@kernel_part(fastmath=FAST, error_model="numpy")
def _transmit(state, hits, first, count, base):
    """Computes T^2 = NUM / DEN at the depths in plane MEDIAN; its slope ``-d ln T^2 / dt`` goes to plane MEAN.

    Takes two hits at a time: while one's quotient is computed, the other is in the works.
    """
    for lane in range(LANES):
        k = base + np.uintp(lane)
        state[k + planes.NUM] = ONE
        state[k + planes.DEN] = ONE
        state[k + planes.MEAN] = ZERO
    for c in range(first, first + count, 2):
        pair = hits[c * HIT_SIZE : (c + 2) * HIT_SIZE]
        for lane in range(LANES):
            v = np.uintp(lane)
            k = base + v
            t = state[k + planes.MEDIAN]
            num, den, slope = state[k + planes.NUM], state[k + planes.DEN], state[k + planes.MEAN]
            num, den, slope = _pass_hit(pair, v, t, num, den, slope)
            num, den, slope = _pass_hit(pair, v + planes.NEXT_HIT, t, num, den, slope)
            state[k + planes.NUM], state[k + planes.DEN], state[k + planes.MEAN] = num, den, slope


@kernel_part(fastmath=FAST, error_model="numpy")
def _bracket(state, hits, first, count, base, median_max, near, newton):
    """Initialises a block's search: the bracket LO to HI, the guess MEDIAN, and MOVING = 1 where a median is sought."""
    cut = ZERO * near
    for lane in range(LANES):
        k = base + np.uintp(lane)
        final, guess = abs(state[k]), state[k + planes.MEDIAN]
        reach = FOUR / math.sqrt(state[k + planes.THIN])
        lo = state[k + planes.LO] - reach
        wanted = final < median_max
        cut += ONE if wanted & (lo < near) else ZERO
        lo = max(lo, near)
        hi = max(state[k + planes.HI] + (reach if final > QUARTER else ZERO), lo)
        guess = guess if newton & (guess > lo) & (guess < hi) else HALF * (lo + hi)
        state[k + planes.LO], state[k + planes.HI], state[k + planes.MEDIAN] = lo, hi, guess
        state[k + planes.LAST] = BIG
        state[k + planes.MOVING] = ONE if wanted else ZERO
    if cut == ZERO:
        return
    for lane in range(LANES):  # the near plane cuts a bracket: drop rays whose median lies in front of it
        k = base + np.uintp(lane)
        state[k + planes.LAST], state[k + planes.MEDIAN] = state[k + planes.MEDIAN], state[k + planes.LO]
    _transmit(state, hits, first, count, base)
    for lane in range(LANES):
        k = base + np.uintp(lane)
        state[k + planes.MEDIAN], state[k + planes.LAST] = state[k + planes.LAST], BIG
        moving = state[k + planes.MOVING]
        state[k + planes.MOVING] = moving if state[k + planes.NUM] > QUARTER * state[k + planes.DEN] else ZERO


@kernel_part(fastmath=FAST, error_model="numpy")
def _solve(state, hits, counts, block, parameters, steps, newton):
    """Writes the median depth of a block's rays (0: none) to plane MEDIAN, its slope S to MEAN; stops if converged."""
    tolerance, base = parameters[5], np.uintp(block * LANES)
    first, count = _fill_up(hits, counts, block)
    _bracket(state, hits, first, count, base, parameters[2], parameters[3], newton)
    for lane in range(LANES):
        k = base + np.uintp(lane)
        state[k + planes.SOUGHT] = state[k + planes.MOVING]
    for _ in range(steps):
        if positive_lanes(state, base + planes.MOVING) == 0:  # pyright: ignore[reportCallIssue]
            break
        _transmit(state, hits, first, count, base)
        for lane in range(LANES):
            k = base + np.uintp(lane)
            num, den, slope = FOUR * state[k + planes.NUM], state[k + planes.DEN], state[k + planes.MEAN]
            lo, middle, hi = state[k + planes.LO], state[k + planes.MEDIAN], state[k + planes.HI]
            lo, hi = (middle, hi) if num > den else (lo, middle)
            # Newton step; ln(num / den) is 2 (num - den) / (num + den) up to third-order terms
            aim = middle + TWO * (num - den) / ((num + den) * (slope if slope > ZERO else ONE))
            good = newton & (slope > ZERO) & (aim >= lo) & (aim <= hi)
            good &= abs(aim - middle) <= HALF * state[k + planes.LAST]
            moved = aim if good else HALF * (lo + hi)
            change = abs(moved - middle)
            sought = state[k + planes.MOVING] > ZERO
            state[k + planes.LO], state[k + planes.HI] = lo, hi
            state[k + planes.LAST] = change
            state[k + planes.MEDIAN] = moved if sought else middle
            state[k + planes.MOVING] = change - tolerance * moved if sought else ZERO
    if not newton:
        _transmit(state, hits, first, count, base)
    for lane in range(LANES):
        k = base + np.uintp(lane)
        sought = state[k + planes.SOUGHT] > ZERO
        median, slope = state[k + planes.MEDIAN], HALF * state[k + planes.MEAN]
        state[k + planes.MEDIAN] = median if sought else ZERO
        state[k + planes.MEAN] = slope if sought else ZERO


# Module globals, not closure variables: numba's cache never finds a kernel whose closure holds another kernel.
_blend_color = _make_blend_tile(False, False)
_blend_rasterized = _make_blend_tile(True, False)
_blend_solid = _make_blend_tile(True, True)


def _make_forward_tiles(geometry: bool, solid: bool) -> Callable[..., int]:
    """Compiles the forward pass over tiles; ``geometry`` (depth and normals) and ``solid`` are constants in it."""

    @kernel(fastmath=FAST, error_model="numpy", nogil=True)
    def forward_tiles(
        records, boxes, colors, members, visits, starts, tiles, expected, steps, newton, parameters, background,
        state, hits, counts, staged, touched, color, normal, depth, slope, transmittance,
    ):  # fmt: skip
        """Renders tiles ``tiles[0] .. tiles[1] - 1`` of one view.

        Stops at a tile that overflows ``hits``; returns that tile, or ``tiles[1]``.
        """
        height, width = depth.shape
        across = -(-width // TILE)
        for tile in range(tiles[0], tiles[1]):
            x_tile, y_tile = (tile % across) * TILE, (tile // across) * TILE
            columns, rows = min(TILE, width - x_tile), min(TILE, height - y_tile)
            begin, end = starts[tile], starts[tile + 1]
            state[:] = ZERO
            counts[:] = 0
            start_rays(state, columns, rows)
            if solid:
                state[planes.LO : planes.LO + PLANE] = BIG
                state[planes.THIN : planes.THIN + PLANE] = BIG
            args = (
                records, colors, boxes, members[begin:end], visits[begin:end], x_tile, y_tile, parameters,
                state, hits, counts, staged, touched,
            )  # fmt: skip
            if solid:
                _blend_solid(*args)
            elif geometry:
                _blend_rasterized(*args)
            else:
                _blend_color(*args)
            if geometry and solid:
                if counts.max() > _first_entry(hits, 0)[1]:
                    return tile
                for block in range(BLOCKS):
                    _solve(state, hits, counts, block, parameters, steps, newton)
            for y in range(rows):
                for x in range(columns):
                    k = place_of(y, x)
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
        return tiles[1]

    return forward_tiles


forward_color = _make_forward_tiles(False, False)
forward_rasterized = _make_forward_tiles(True, False)
forward_solid = _make_forward_tiles(True, True)
