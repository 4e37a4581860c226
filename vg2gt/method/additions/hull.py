"""Visual hull: takes away what the masks of cut-out objects show to be empty.

Masks have two uses. Those of a cut-out object or of the sky say that there is nothing else; others hide things that
move, an operator, or the edge of a lens, behind which the scene goes on. The points tell which: other views see the
scene behind what moved, and nothing around an object.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.geometry.cameras import project, unproject
from vg2gt.types import Cameras

_MARGIN = 2  # pixels around a mask that count as inside
# share of the hidden area behind which other views see points: of clean and of rough cut-outs
_EMPTY, _UNSURE = 0.3, 0.6
_RARE, _MOST = 0.05, 0.5  # share of a point's views that see it outside, if it is wrong: of clean and of rough cut-outs
_CELLS = 24  # across the longer side of an image, in which the hidden area is counted
_POINTS = 40_000  # points that are projected to count it
_LEAST = 0.02  # share of the pixels that must be hidden


@dataclass(frozen=True)
class Meaning:
    """What masks say about the hidden area.

    Attributes:
        share: share of its views above which a point seen outside of the masks is wrong; None: the area says nothing.
        is_object: whether there is nothing around the object, so that it needs no surroundings.
    """

    share: float | None
    is_object: bool


@torch.no_grad()
def meaning_of(depth: Tensor, cameras: Cameras, mask: Tensor) -> Meaning:
    """Returns what masks say: whether they cut out an object, leave out the sky, or hide parts of the scene.

    Args:
        depth: ``[V, H, W]`` z-depth, 0 = none; 0 where masked.
        cameras: cameras of the views (B = 1).
        mask: ``[V, H, W]`` in [0, 1]; pixels at or below 0.5 are hidden.
    """
    border = torch.cat([each.flatten() for each in (mask[:, 0], mask[:, -1], mask[:, :, 0], mask[:, :, -1])])
    is_object = bool(border.gt(0.5).float().mean() < 0.5)
    covered = _covered(depth, cameras, mask)
    if covered < _EMPTY:
        return Meaning(_RARE, is_object)
    return Meaning(_MOST, True) if is_object and covered < _UNSURE else Meaning(None, False)


def _covered(depth: Tensor, cameras: Cameras, mask: Tensor) -> float:
    """Returns the share of the hidden area behind which other views see points; 1 if too little is hidden."""
    hidden = mask <= 0.5
    if len(mask) < 2 or hidden.float().mean() < _LEAST or not (depth > 0).any():
        return 1.0
    step = max(1, round((depth.numel() / _POINTS) ** 0.5))
    grid = (slice(None), slice(step // 2, None, step), slice(step // 2, None, step))
    world = unproject(depth[None], cameras)[0][grid][depth[grid] > 0]  # [N, 3]
    cell = max(1, max(cameras.size) // _CELLS)
    whole = -F.max_pool2d(-hidden.float()[:, None], cell)[:, 0]  # cells without a visible pixel
    covered = 0.0
    for view in range(len(mask)):
        x, y, seen = _pixels(world, cameras.select(slice(view, view + 1)))
        cells = torch.zeros_like(whole[view])
        rows, columns = (y[seen] // cell).clamp(max=cells.shape[0] - 1), (x[seen] // cell).clamp(max=cells.shape[1] - 1)
        cells[rows, columns] = 1
        covered += float((cells * whole[view]).sum())
    return covered / float(whole.sum()) if whole.any() else 1.0


@torch.no_grad()
def outside_hull(points: Tensor, cameras: Cameras, mask: Tensor, share: float) -> Tensor:
    """Returns ``[N]`` bool, true for points that more than a share of their views see outside of their masks.

    Args:
        points: ``[N, 3]`` in the world of the cameras.
        cameras: cameras of the views (B = 1).
        mask: ``[V, H, W]`` in [0, 1]; pixels at or below 0.5 are hidden.
        share: see :class:`Meaning`.
    """
    count = torch.zeros(2, len(points), device=points.device)  # views that see a point, and that see it outside
    for view in range(len(mask)):
        wider = F.max_pool2d((mask[view] > 0.5).float()[None, None], 2 * _MARGIN + 1, 1, _MARGIN)
        inside = wider[0, 0].to(points.device)
        x, y, seen = _pixels(points, cameras.select(slice(view, view + 1)))
        count[0] += seen
        count[1, seen] += 1 - inside[y[seen], x[seen]]
    return count[1] > share * count[0]


def _pixels(points: Tensor, camera: Cameras) -> tuple[Tensor, Tensor, Tensor]:
    """Returns the pixel column and row ``[N]`` of points in one view, and whether they are in the image."""
    place, z = project(points[None, None], camera)
    x, y = place[0, 0].nan_to_num(-1, -1, -1).clamp(-1e6, 1e6).round().long().unbind(-1)
    height, width = camera.size
    return x, y, (z[0, 0] > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
