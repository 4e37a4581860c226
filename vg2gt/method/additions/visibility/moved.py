"""Detects moving objects: pixels whose surface is present at one moment and gone at another.

Frames are grouped into moments of a few consecutive frames. Views of the same moment agree with a moving object's
depth, views of another moment look through it. Counted over all views, an object that stays in place for half of the
frames looks like correct depth. Counted per moment, all views of another moment contradict it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from vg2gt.method.additions.visibility.counts import count_views
from vg2gt.types import Cameras

LEAST = 2  # smallest number of views of a moment that look through a point, while none of them agrees


@torch.no_grad()
def moved(
    depth: Tensor, cameras: Cameras, partners: Tensor, frames: Tensor, moment: int, tolerance: float, margin: float
) -> Tensor:
    """Returns the pixels ``[V, H, W]`` bool whose surface is gone at some moment, for one scene.

    Args:
        depth: ``[V, H, W]`` z-depth, 0 = none.
        cameras: cameras of the views (B = 1), in the unit of the depth.
        partners: ``[V, K]`` int64, views that each view is compared with; -1 = none.
        frames: ``[V]`` frame numbers in temporal order.
        moment: smallest number of consecutive frames in a moment, and of partners in it; with fewer than twice as many
            views, there is only one moment.
        tolerance: relative depth difference below which views agree.
        margin: relative depth difference above which a view looks through a point.
    """
    views, most = len(depth), partners.shape[1]
    compared = views if most == views - 1 else most // 2  # unless all views are partners, only half are spread evenly
    moments = max(min(views, compared) // moment, 1)
    when = frames.argsort(stable=True).argsort() * moments // views  # [V]
    gone = torch.zeros_like(depth, dtype=torch.bool)
    for one in range(moments):
        # partners in this moment, for the views of other moments: [V, K]
        then = (partners >= 0) & (when[partners.clamp(min=0)] == one) & (when[:, None] != one)
        few = then.sum(1).max().item() if then.numel() else 0
        if few < LEAST:
            continue
        chosen = torch.where(then, partners, -1).sort(1, descending=True).values[:, : int(few)].contiguous()
        counts = count_views(depth, cameras, chosen, tolerance, margin)
        gone |= (counts.through >= LEAST) & (counts.agree == 0)
    return gone
