"""Keeps the backbone's depth where other views confirm it: our addition to the paper's enhancement."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.types import Geometry
from vg2gt.visibility.check import ViewCheck, choose_partners
from vg2gt.visibility.counts import count_views

# Pixels per side of the square around a pixel; a choice by the pixel alone leaves steps. Chosen on IterMVS with the
# product of both shares: without the scene's, the office is 7 % worse than before enhancement.
_AROUND = 9


def keep_agreed(initial: Geometry, depth: Tensor, check: ViewCheck) -> Tensor:
    """Mixes the enhanced depth with the backbone's, by how many pixels of it other views confirm.

    A pixel is confirmed if another view agrees with its initial depth and none looks through its point. The enhanced
    depth is learnt mostly from pixels that are far off, and can be less accurate than depth that was matched well. Its
    share is the share of pixels that are not confirmed around the pixel, times that of the whole scene.

    Args:
        initial: the backbone's geometry of B scenes; used without gradient.
        depth: ``[B, V, H, W]`` enhanced depth of the same pixels, in the same unit; 0 = none.
        check: gives tolerance, margin and number of partners.

    Returns:
        The mixed depth ``[B, V, H, W]``: a geometric mean, with the gradient of the enhanced part. ``depth`` where
        either is 0.
    """
    before = initial.depth.detach().nan_to_num(0.0, 0.0, 0.0).to(depth.dtype)
    share = torch.stack([_unconfirmed(before[b], initial, b, check) for b in range(len(before))])
    both = (before > 0) & (depth > 0)
    logs = [torch.where(both, part, 1.0).log() for part in (before, depth)]
    return torch.where(both, torch.lerp(logs[0], logs[1], share).exp(), depth)


@torch.no_grad()
def _unconfirmed(depth: Tensor, initial: Geometry, scene: int, check: ViewCheck) -> Tensor:
    """Returns the share ``[V, H, W]`` of unconfirmed pixels around each pixel, times that of the whole scene."""
    cameras = initial.cameras.scene(scene)
    partners = choose_partners(depth, cameras, check.partners)
    counts = count_views(depth, cameras, partners, check.tolerance, check.margin)
    unconfirmed = ((counts.agree == 0) | (counts.through > 0)).to(depth.dtype)
    around = F.avg_pool2d(unconfirmed[:, None], _AROUND, 1, _AROUND // 2, count_include_pad=False)[:, 0]
    return around * unconfirmed[depth > 0].mean().nan_to_num(1.0)
