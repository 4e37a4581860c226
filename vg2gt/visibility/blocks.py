"""Checks many views one block at a time: same result as :class:`ViewCheck`, with only a few views' depth in memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from vg2gt.types import Cameras
from vg2gt.visibility.check import NEIGHBORS, ViewCheck, disagreement, weighted
from vg2gt.visibility.counts import count_views

LOOKED_AT, FEW = 32, 100  # evenly spaced views whose disagreement is measured; up to FEW views, all of them


@torch.no_grad()
def check_blocks(
    check: ViewCheck,
    depth: Tensor,
    cameras: Cameras,
    partners: Tensor,
    blocks: Sequence[slice],
    masks: tuple[Tensor, Tensor],
) -> Iterator[None]:
    """Checks the depth of one scene like :meth:`ViewCheck.__call__` without ``moment``; yields after each block.

    Args:
        check: the options.
        depth: ``[V, H, W]`` z-depth, 0 = none; may be memory-mapped.
        cameras: cameras of the views (B = 1).
        partners: ``[V, K]`` from :func:`choose_partners`.
        blocks: slices of views whose partners' depth fits in memory; together they cover all views.
        masks: two buffers ``[V, H, W]``, overwritten; at the end the first is 1 for pixels that are kept, else 0.
    """
    before, after = masks
    limits = check.tolerance, check.margin, weighted(len(depth))
    for rows in blocks:
        before[rows] = (depth[rows] > 0).to(before.dtype)
    for _ in range(check.rounds):
        for rows in blocks:
            views, local = neighbourhood(partners, torch.arange(rows.start, rows.stop))
            left = depth[views] * before[views]
            counts = count_views(left, cameras.select(views), local, *limits)
            inside = slice(0, rows.stop - rows.start)
            kept = counts.through[inside] <= counts.agree[inside]
            after[rows] = before[rows] * kept.to(before.dtype)
            yield
        before[:] = after


def neighbourhood(partners: Tensor, views: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the given views followed by their partners ``[n]``, and the partners ``[n, K]`` as indices into them.

    The added views have no partners themselves (-1).

    Args:
        partners: ``[V, K]`` partners of all views, -1 = none.
        views: ``[m]`` indices of the given views.
    """
    named = partners[views].flatten()
    others = named[(named >= 0) & ~torch.isin(named, views)].unique()
    chosen = torch.cat((views, others))
    place = torch.full((len(partners) + 1,), -1, dtype=torch.int64)
    place[chosen] = torch.arange(len(chosen))  # index -1 reads the last entry, which stays -1
    local = torch.full((len(chosen), partners.shape[1]), -1, dtype=torch.int64)
    local[: len(views)] = place[partners[views]]
    return chosen, local


@torch.no_grad()
def coarsening(check: ViewCheck, depth: Tensor, cameras: Cameras, partners: Tensor) -> Tensor:
    """Returns the factor ``[1]`` on the smallest voxel size; arguments as for :func:`check_blocks`."""
    chosen = torch.arange(len(depth))
    if len(depth) > FEW:
        chosen = torch.linspace(0, len(depth) - 1, LOOKED_AT).round().long()
    views, local = neighbourhood(partners[:, :NEIGHBORS], chosen)
    apart = disagreement(depth[views], cameras.select(views), local)
    return (apart / check.fine_below).clamp(1, check.coarsest)[None]
