"""Merges the voxels of all windows, one slab of space at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path

import torch

from vg2gt.method.pooled import PooledVoxels, concatenate, merge
from vg2gt.reconstruction.windows.store import read_rows

ROWS = 400_000  # voxels merged at a time


def as_tensors(pooled: PooledVoxels) -> dict[str, torch.Tensor]:
    """Returns the tensors of a window's voxels, to be stored."""
    return {each: value for each, value in vars(pooled).items() if value is not None}


def merge_windows(files: Sequence[Path], show: Callable[[float], None], limit: int = ROWS) -> PooledVoxels:
    """Merges the voxels of all windows of a scene.

    The voxels of each window are sorted by x, so that a slab of space is a range of rows in each file.

    Args:
        files: voxel files of the windows, in the order of summation.
        show: called with the share done.
        limit: approximate number of voxels merged at a time.

    Raises:
        ValueError: if there are no voxels.
    """
    columns = [read_rows(file, slice(None))["grid"][:, 0].contiguous() for file in files]
    slabs = _slabs(columns, limit)
    merged = []
    for number, (low, high) in enumerate(slabs):
        parts = []
        for file, column in zip(files, columns, strict=True):
            begin, end = torch.searchsorted(column, torch.tensor([low, high])).tolist()
            if end > begin:
                parts.append(_pooled(read_rows(file, slice(begin, end))))
        merged.append(merge(parts))
        show((number + 1) / len(slabs))
    if not merged:
        raise ValueError("the backbone found no depth in any image, so there is nothing to reconstruct")
    return merged[0] if len(merged) == 1 else concatenate(merged)


def _slabs(columns: Sequence[torch.Tensor], limit: int) -> list[tuple[int, int]]:
    """Returns ranges of x that hold about ``limit`` entries of the sorted columns each."""
    places, counts = torch.cat(list(columns)).unique(return_counts=True)
    slab = (counts.cumsum(0) - counts) // limit
    starts = torch.cat((torch.ones(1, dtype=torch.bool), slab.diff() > 0)).nonzero()[:, 0] if len(places) else []
    bounds = [int(places[start]) for start in starts]
    return list(zip(bounds, [*bounds[1:], int(places[-1]) + 1], strict=True)) if bounds else []


def _pooled(tensors: dict[str, torch.Tensor]) -> PooledVoxels:
    return PooledVoxels(**{each.name: tensors.get(each.name) for each in fields(PooledVoxels)})  # pyright: ignore
