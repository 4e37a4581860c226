"""Which pixels show what moves: it is there at one moment and gone at another.

Frames in the order of time are cut into moments of a few frames. A view that looks through a pixel's point sees that
nothing is there at its moment; views of the pixel's own moment agree with it. Over all views such a thing looks like
good depth as long as it stays in one place for half of the frames. Within one moment it is contradicted by everyone.
"""

from __future__ import annotations

import torch
from torch import Tensor

from vg2gt.method.additions.visibility.counts import count_views
from vg2gt.types import Cameras

LEAST = 2  # views of a moment that look through a point which none of them agrees with


@torch.no_grad()
def moved(
    depth: Tensor, cameras: Cameras, partners: Tensor, frames: Tensor, moment: int, tolerance: float, margin: float
) -> Tensor:
    """Pixels ``[V, H, W]`` bool whose surface is gone at some moment, for one scene.

    Args:
        depth: ``[V, H, W]`` z-depth, 0 = none.
        cameras: of the views (B = 1), in the unit of the depth.
        partners: ``[V, K]`` int64 views that each view is compared with; -1 = none.
        frames: ``[V]`` numbers of the frames in the order of time.
        moment: least number of consecutive frames of a moment, and of partners in it; fewer than twice as many views
            are one moment.
        tolerance: relative difference of depth up to which views agree.
        margin: relative difference of depth from which on a view looks through a point.
    """
    views, most = len(depth), partners.shape[1]
    compared = views if most == views - 1 else most // 2  # of more views, only half of the partners are spread evenly
    moments = max(min(views, compared) // moment, 1)
    when = frames.argsort(stable=True).argsort() * moments // views  # [V]
    gone = torch.zeros_like(depth, dtype=torch.bool)
    for one in range(moments):
        then = (partners >= 0) & (when[partners.clamp(min=0)] == one) & (when[:, None] != one)
        few = then.sum(1).max().item() if then.numel() else 0
        if few < LEAST:
            continue
        chosen = torch.where(then, partners, -1).sort(1, descending=True).values[:, : int(few)].contiguous()
        counts = count_views(depth, cameras, chosen, tolerance, margin)
        gone |= (counts.through >= LEAST) & (counts.agree == 0)
    return gone
