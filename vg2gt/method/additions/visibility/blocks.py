"""The check of many views a block at a time: what :class:`ViewCheck` says of all, with a few views' depth in memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from vg2gt.method.additions.visibility.check import NEIGHBORS, ViewCheck, disagreement
from vg2gt.method.additions.visibility.counts import count_views
from vg2gt.types import Cameras

LOOKED_AT, FEW = 32, 100  # views whose disagreement is measured, evenly spread; of up to FEW, all are


@torch.no_grad()
def check_blocks(
    check: ViewCheck,
    depth: Tensor,
    cameras: Cameras,
    partners: Tensor,
    blocks: Sequence[slice],
    masks: tuple[Tensor, Tensor],
) -> Iterator[None]:
    """Checks the depth of one scene; equal to :meth:`ViewCheck.__call__`. Steps once a round and block.

    Args:
        check: the options.
        depth: ``[V, H, W]``, 0 where there is none; may be mapped from a file.
        cameras: of the views (B = 1).
        partners: ``[V, K]`` from :func:`choose_partners`.
        blocks: views whose partners' depth is in memory together; all views between them.
        masks: ``[V, H, W]`` each, written over: after the last step the first holds 1 for pixels that are kept.
    """
    before, after = masks
    for rows in blocks:
        before[rows] = (depth[rows] > 0).to(before.dtype)
    for _ in range(check.rounds):
        for rows in blocks:
            views, local = neighbourhood(partners, torch.arange(rows.start, rows.stop))
            left = depth[views] * before[views]
            counts = count_views(left, cameras.select(views), local, check.tolerance, check.margin)
            inside = slice(0, rows.stop - rows.start)
            kept = counts.through[inside] <= counts.agree[inside]
            after[rows] = before[rows] * kept.to(before.dtype)
            yield
        before[:] = after


def neighbourhood(partners: Tensor, views: Tensor) -> tuple[Tensor, Tensor]:
    """Some views and after them their partners ``[n]``, and all these views' partners ``[n, K]`` counted among them.

    The partners themselves have none (-1).

    Args:
        partners: ``[V, K]`` of all views, -1 = none.
        views: ``[m]`` the wanted ones.
    """
    named = partners[views].flatten()
    others = named[(named >= 0) & ~torch.isin(named, views)].unique()
    chosen = torch.cat((views, others))
    place = torch.full((len(partners) + 1,), -1, dtype=torch.int64)
    place[chosen] = torch.arange(len(chosen))  # the last entry is -1's
    local = torch.full((len(chosen), partners.shape[1]), -1, dtype=torch.int64)
    local[: len(views)] = place[partners[views]]
    return chosen, local


@torch.no_grad()
def coarsening(check: ViewCheck, depth: Tensor, cameras: Cameras, partners: Tensor) -> Tensor:
    """The factor ``[1]`` of the smallest voxel; arguments as for :func:`check_blocks`."""
    chosen = torch.arange(len(depth))
    if len(depth) > FEW:
        chosen = torch.linspace(0, len(depth) - 1, LOOKED_AT).round().long()
    views, local = neighbourhood(partners[:, :NEIGHBORS], chosen)
    apart = disagreement(depth[views], cameras.select(views), local)
    return (apart / check.fine_below).clamp(1, check.coarsest)[None]
