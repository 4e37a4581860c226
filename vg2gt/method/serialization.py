"""Space-filling curves through voxels, and windows of consecutive voxels along them (Point Transformer V3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor

from vg2gt.kernels.curve_codes import hilbert_codes, z_codes

Order = Literal["z", "z-trans", "hilbert", "hilbert-trans"]
ORDERS: tuple[Order, ...] = get_args(Order)
_MAX_BITS = 21  # per axis; a code has three times as many bits of an int64


def serial_codes(grid: Tensor, bits: int, orders: Sequence[Order]) -> list[Tensor]:
    """Returns the codes ``[M]`` of cells ``[M, 3]`` in each of the orders; the transposed orders exchange x and y.

    Each unused leading bit rotates a Hilbert curve by a third of a full turn. Rounding the number of bits up to a
    multiple of three makes a cell's code independent of ``bits``, and so of the other scenes in a batch.
    """
    x, y, z = grid.unbind(-1)
    both = torch.cat((grid, torch.stack((y, x, z), -1)))  # all curves of a kind at once
    codes = {}
    if any(order.startswith("z") for order in orders):
        codes["z"], codes["z-trans"] = z_codes(both).chunk(2)
    if any(order.startswith("hilbert") for order in orders):
        codes["hilbert"], codes["hilbert-trans"] = hilbert_codes(both, -(-bits // 3) * 3).chunk(2)
    return [codes[order] for order in orders]


def relative_grid(grid: Tensor, batch: Tensor, scenes: int) -> Tensor:
    """Returns cells ``[M, 3]`` relative to their own scene's smallest, so that codes depend on no other scene."""
    low = grid.new_zeros(scenes, 3)
    low.scatter_reduce_(0, batch[:, None].expand_as(grid), grid, "amin", include_self=False)
    return grid - low[batch]


def serial_keys(
    grid: Tensor,
    batch: Tensor,
    voxel_size: Tensor,
    orders: Sequence[Order],
    min_bits: int = 1,
    extent: int | None = None,
) -> Tensor:
    """Returns sort keys ``scene << (3 * bits) | code``: ``[orders, M]``.

    Args:
        grid: ``[M, 3]`` cells relative to their scene's smallest.
        batch: ``[M]`` scene index.
        voxel_size: ``[B]`` edge lengths, for the error message.
        orders: serialisation orders.
        min_bits: smallest number of bits per axis, so that keys can be shifted to parents this many times.
        extent: cells along the longest axis; None computes it, which synchronises with a GPU.

    Raises:
        ValueError: if code and scene index do not fit into 63 bits, or an axis needs more than 21.
    """
    extent, scenes = int(grid.max()) + 1 if extent is None else extent, len(voxel_size)
    bits = max(min_bits, (extent - 1).bit_length())
    if bits > _MAX_BITS or 3 * bits + (scenes - 1).bit_length() > 63:
        sizes = ", ".join(f"{size:g}" for size in voxel_size.tolist())
        raise ValueError(
            f"a scene spans {extent} voxels along one axis (voxel size {sizes}, {scenes} scenes), too many for "
            "63-bit serial codes; increase voxel_size or min_footprint"
        )
    return (batch << (3 * bits)) | torch.stack(serial_codes(grid, bits, orders))


@dataclass(frozen=True)
class _WindowGroup:
    """Windows of one length. Scenes with fewer voxels than the requested length are in groups of their own.

    Attributes:
        rows: ``[W, K]`` voxels of every window, scene after scene.
        counts: number of windows per scene of this group.
    """

    rows: Tensor
    counts: tuple[int, ...]


@dataclass(frozen=True)
class Windows:
    """Windows of consecutive voxels along a curve, never across scenes; every voxel is owned by exactly one window.

    A window that would extend beyond its scene is shifted inwards and overlaps its neighbour, so that neither padding
    nor a mask is needed. The neighbour owns the voxels in the overlap.

    Attributes:
        groups: the windows, grouped by length.
        owner: ``[M]`` position of every voxel in the concatenation of all groups' ``rows.flatten()``.
    """

    groups: tuple[_WindowGroup, ...]
    owner: Tensor

    def along(self, order: Tensor) -> Windows:
        """Returns windows of positions on a curve as windows of the voxels ``order`` ``[M]`` along it."""
        groups = tuple(_WindowGroup(order[group.rows], group.counts) for group in self.groups)
        return Windows(groups, torch.empty_like(order).scatter_(0, order, self.owner))


def make_windows(counts: list[int], length: int, device: torch.device, shift: int = 0) -> Windows:
    """Cuts the positions along a curve into windows, for :meth:`Windows.along`.

    Args:
        counts: number of voxels per scene.
        length: voxels per window; a scene with fewer voxels is a single window.
        device: device of the curve.
        shift: the first window starts this many voxels before the scene, 0 <= shift < length.
    """
    by_length: dict[int, list[tuple[int, int]]] = {}
    begin = 0
    for count in counts:
        if count:
            by_length.setdefault(min(length, count), []).append((begin, count))
        begin += count
    groups, base = [], 0
    owners: dict[int, Tensor] = {}
    for size, scenes in by_length.items():
        rows = []
        for begin, count in scenes:
            first = -shift if count > length else 0
            starts = torch.arange(first, count, size, device=device)  # [W]
            inside = starts.clamp(0, count - size)
            moved = starts - inside + (base - first)  # from a place in the scene to one in the windows
            place = torch.arange(count, device=device)
            owners[begin] = place + moved[(place - first) // size]
            rows.append((inside + begin)[:, None] + torch.arange(size, device=device))  # [W, K]
            base += len(inside) * size
        groups.append(_WindowGroup(_cat(rows), tuple(map(len, rows))))
    return Windows(tuple(groups), _cat([owners[begin] for begin in sorted(owners)]))


def _cat(parts: list[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(parts)
