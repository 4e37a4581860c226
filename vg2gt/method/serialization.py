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
MAX_BITS = 21  # a code takes three times as many bits of an int64


def serial_codes(grid: Tensor, bits: int, order: Order) -> Tensor:
    """Codes ``[M]`` of cells ``[M, 3]`` in one of the orders; the transposed ones exchange x and y.

    Unused leading bits turn a Hilbert curve by a third of a full turn each; rounding their number up to a multiple of
    three makes a cell's code independent of ``bits``, and so of the other scenes in a batch.
    """
    if order.endswith("-trans"):
        x, y, z = grid.unbind(-1)
        grid = torch.stack((y, x, z), -1)
    return z_codes(grid) if order.startswith("z") else hilbert_codes(grid, -(-bits // 3) * 3)


def relative_grid(grid: Tensor, batch: Tensor, scenes: int) -> Tensor:
    """Cells ``[M, 3]`` relative to their own scene's smallest, so that a code depends on no other scene."""
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
) -> list[Tensor]:
    """Sort keys ``scene << 3 bits | code``, one ``[M]`` tensor per order.

    Args:
        grid: ``[M, 3]`` cells relative to their scene's smallest.
        batch: ``[M]`` scene index.
        voxel_size: ``[B]`` edge lengths, named in the error.
        orders: the wanted orders.
        min_bits: bits per axis at least, so that keys can be shifted to parents this many times.
        extent: cells along the longest axis where that is known; to find it out, the host waits for a GPU.

    Raises:
        ValueError: if code and scene index do not fit into 63 bits, or an axis not into 21.
    """
    extent, scenes = int(grid.max()) + 1 if extent is None else extent, len(voxel_size)
    bits = max(min_bits, (extent - 1).bit_length())
    if bits > MAX_BITS or 3 * bits + (scenes - 1).bit_length() > 63:
        sizes = ", ".join(f"{size:g}" for size in voxel_size.tolist())
        raise ValueError(
            f"a scene spans {extent} voxels along an axis (voxel size {sizes}, {scenes} scenes); with "
            f"the scene index that exceeds 63 bits of serial code; raise voxel_size or min_footprint"
        )
    scene = batch << (3 * bits)
    return [scene | serial_codes(grid, bits, order) for order in orders]


@dataclass(frozen=True)
class WindowGroup:
    """Windows of one length. Scenes shorter than the wanted length make a group of their own.

    Attributes:
        rows: ``[W, K]`` voxels of every window, scene after scene; windows at the end that nobody owns hold one voxel.
        counts: windows of each scene that has some here, without those.
    """

    rows: Tensor
    counts: tuple[int, ...]


@dataclass(frozen=True)
class Windows:
    """Windows of consecutive voxels along a curve, never across scenes; every voxel is owned by exactly one.

    A window that would stick out at an end of its scene slides inwards and overlaps its neighbour, so no padding and
    no mask is ever needed; of the overlap it owns nothing.

    Attributes:
        groups: the windows, grouped by length.
        owner: ``[M]`` for every voxel its place in the concatenation of all groups' ``rows.flatten()``.
    """

    groups: tuple[WindowGroup, ...]
    owner: Tensor

    def along(self, order: Tensor) -> Windows:
        """Windows of voxels ``order [M]`` along a curve, where these are of places along it."""
        groups = tuple(WindowGroup(order[group.rows], group.counts) for group in self.groups)
        return Windows(groups, torch.empty_like(order).scatter_(0, order, self.owner))


def make_windows(order: Tensor, counts: list[int], length: int, shift: int = 0, few_sizes: bool = False) -> Windows:
    """Cuts the serialised voxels of every scene into windows.

    Args:
        order: ``[M]`` voxels along the curve, scene after scene.
        counts: voxels of each scene.
        length: voxels per window; a scene with fewer makes one window of what it has.
        shift: the first window starts this many voxels before the scene does, 0 <= shift < length.
        few_sizes: adds windows that nobody owns, at most an eighth, so that groups have few different sizes.
    """
    by_length: dict[int, list[tuple[int, int]]] = {}
    begin = 0
    for count in counts:
        if count:
            by_length.setdefault(min(length, count), []).append((begin, count))
        begin += count
    groups, base = [], 0
    owner = torch.empty_like(order)
    for size, scenes in by_length.items():
        rows = []
        for begin, count in scenes:
            voxels = order[begin : begin + count]
            first = -shift if count > length else 0
            inside = torch.arange(first, count, size, device=order.device).clamp(0, count - size)  # [W]
            place = torch.arange(count, device=order.device)
            window = (place - first) // size
            owner[voxels] = base + window * size + place - inside[window]
            rows.append(voxels[inside[:, None] + torch.arange(size, device=order.device)])  # [W, K]
            base += len(inside) * size
        windows = tuple(map(len, rows))
        if few_sizes:
            spare = -sum(windows) % (1 << max(sum(windows).bit_length() - 4, 0))
            rows.append(rows[0][:1, :1].expand(spare, size))
            base += spare * size
        groups.append(WindowGroup(torch.cat(rows), windows))
    return Windows(tuple(groups), owner)
