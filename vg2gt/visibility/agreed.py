"""Keeps the backbone's depth where other views confirm it: our addition to the paper's enhancement."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.types import Geometry
from vg2gt.visibility.check import ViewCheck, choose_partners
from vg2gt.visibility.counts import count_views

_AROUND = 9  # pixels per side of the square whose share of confirmed pixels is the weight; a hard choice leaves steps


def keep_agreed(initial: Geometry, depth: Tensor, check: ViewCheck) -> Tensor:
    """Mixes the enhanced depth with the backbone's, by how many of the pixels around it other views confirm.

    A pixel is confirmed if another view agrees with its initial depth and none looks through its point. The enhanced
    depth is learnt mostly from pixels that are far off, and can be less accurate than depth that was matched well.

    Args:
        initial: the backbone's geometry of B scenes; used without gradient.
        depth: ``[B, V, H, W]`` enhanced depth of the same pixels, in the same unit; 0 = none.
        check: gives tolerance, margin and number of partners.

    Returns:
        The mixed depth ``[B, V, H, W]``: a geometric mean, with the gradient of the enhanced part. ``depth`` where
        either is 0.
    """
    before = initial.depth.detach().nan_to_num(0.0, 0.0, 0.0).to(depth.dtype)
    weight = torch.stack([_confirmed(before[b], initial, b, check) for b in range(len(before))])
    both = (before > 0) & (depth > 0)
    logs = [torch.where(both, part, 1.0).log() for part in (before, depth)]
    return torch.where(both, torch.lerp(logs[1], logs[0], weight).exp(), depth)


@torch.no_grad()
def _confirmed(depth: Tensor, initial: Geometry, scene: int, check: ViewCheck) -> Tensor:
    """Returns the share ``[V, H, W]`` of confirmed pixels around each pixel of one scene."""
    cameras = initial.cameras.scene(scene)
    partners = choose_partners(depth, cameras, check.partners)
    counts = count_views(depth, cameras, partners, check.tolerance, check.margin)
    confirmed = (counts.agree >= 1) & (counts.through == 0)
    return F.avg_pool2d(confirmed.to(depth.dtype)[:, None], _AROUND, 1, _AROUND // 2, count_include_pad=False)[:, 0]
