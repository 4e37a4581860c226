"""Triton kernels that list Gaussians by tile: one entry per (tile, Gaussian), sorted by view, tile and depth."""

# pyright: reportGeneralTypeIssues=false, reportOperatorIssue=false
# (Triton's type hints do not cover the operators and ranges used inside kernels)

from __future__ import annotations

import triton  # pyright: ignore[reportMissingImports]
import triton.language as tl  # pyright: ignore[reportMissingImports]

from vg2gt.rendering.gpu.tiles import RECORD

ENTRIES = 256  # entries per program

_ENTRIES = tl.constexpr(ENTRIES)
_RECORD = tl.constexpr(RECORD)


@triton.jit(do_not_specialize=("total", "views", "tiles", "entries", "steps", "across"))
def emit_kernel(
    records, rects, ends, batch, keys, owners, total, views, tiles, across, entries, steps,
):  # fmt: skip
    """Writes the key (view | tile | depth) and slot of each entry. One lane per entry: large Gaussians delay none."""
    e = tl.program_id(0) * _ENTRIES + tl.arange(0, _ENTRIES)
    there = e < entries
    # binary search for the entry's slot
    lo, hi = e * 0, e * 0 + total * views - 1
    step = 0
    while step < steps:
        middle = (lo + hi) >> 1
        before = tl.load(ends + middle) <= e
        lo = tl.where(before & (lo < hi), middle + 1, lo)
        hi = tl.where(before, hi, middle)
        step += 1
    number = e - tl.load(ends + lo - 1, mask=lo > 0, other=0).to(tl.int32)
    slot = lo.to(tl.int64)
    first = tl.load(rects + 2 * slot, mask=there, other=0)
    columns = tl.load(rects + 2 * slot + 1, mask=there, other=1)
    tile = (tl.load(batch + lo % total) * views + lo // total) * tiles
    tile += first + number // columns * across + number % columns
    # bits of positive float32 values sort like the values
    depth = tl.load(records + slot * _RECORD + 7, mask=there, other=1.0).to(tl.float32).to(tl.int32, bitcast=True)
    tl.store(keys + e, (tile << 32) | depth.to(tl.int64), mask=there)
    tl.store(owners + e, lo, mask=there)


@triton.jit(do_not_specialize=("entries", "tiles", "steps"))
def list_kernel(keys, order, owners, members, places, starts, entries, tiles, steps):
    """Writes the slot and gradient row of each sorted entry, and the first entry of each tile."""
    e = tl.program_id(0) * _ENTRIES + tl.arange(0, _ENTRIES)
    there = e < entries
    place = tl.load(order + e, mask=there, other=0)
    tl.store(places + e, place.to(tl.int32), mask=there)
    tl.store(members + e, tl.load(owners + place, mask=there, other=0), mask=there)
    # binary search for the first entry of tile e
    if tl.program_id(0) * _ENTRIES <= tiles:
        lo, hi = e * 0, e * 0 + entries
        step = 0
        while step < steps:
            middle = (lo + hi) >> 1
            before = (middle < entries) & (tl.load(keys + middle, mask=middle < entries, other=0) >> 32 < e)
            lo = tl.where(before & (lo < hi), middle + 1, lo)
            hi = tl.where(before, hi, middle)
            step += 1
        tl.store(starts + e, lo, mask=e <= tiles)
