"""Which views each view is checked against."""

from __future__ import annotations

import torch
from torch import Tensor

from vg2gt.geometry.cameras import crop_intrinsics, unproject
from vg2gt.types import Cameras

SAMPLES = 12  # pixels a side of the grid that overlap is measured on
LEAST = 0.02  # share of a view's samples that a partner has in its image


@torch.no_grad()
def choose_partners(depth: Tensor, cameras: Cameras, most: int) -> Tensor:
    """The views that look where a view's points are, ``[V, min(most, V - 1)]`` int64, -1 where a view has fewer.

    Of more than ``most``, half are the nearest by direction and place, and the others are taken evenly: near views
    agree with a surface, and views from the other side contradict what hangs in the air.
    """
    views, height, width = depth.shape
    count = min(most, views - 1)
    if count < 1:
        return torch.empty(views, 0, dtype=torch.int64, device=depth.device)
    step = (max(height // SAMPLES, 1), max(width // SAMPLES, 1))
    rows, columns = slice(step[0] // 2, None, step[0]), slice(step[1] // 2, None, step[1])
    sampled = depth[:, rows, columns].double()
    pose, intrinsics = cameras.world_to_camera[0].double(), cameras.intrinsics[0].double()
    shifted = crop_intrinsics(intrinsics, step[1] // 2, step[0] // 2)
    strided = torch.cat((shifted[:, :1] / step[1], shifted[:, 1:2] / step[0], shifted[:, 2:]), 1)
    small = Cameras(pose[None], strided[None], (sampled.shape[1], sampled.shape[2]))
    points = unproject(sampled[None], small)[0].flatten(1, 2)  # [V, P, 3]
    known = (sampled > 0).flatten(1)  # [V, P]
    share = torch.zeros(views, views, dtype=torch.float64, device=depth.device)
    for other in range(views):
        seen = points @ pose[other, :3, :3].T + pose[other, :3, 3]
        pixel = seen @ intrinsics[other].T
        z = pixel[..., 2]
        u, v = pixel[..., 0] / z, pixel[..., 1] / z
        inside = known & (z > 0) & (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
        share[:, other] = inside.sum(1) / known.sum(1).clamp(min=1)
    share.fill_diagonal_(0)
    turn = torch.einsum("vij,wij->vw", pose[:, :3, :3], pose[:, :3, :3])  # 1 + 2 cos of the angle between views
    score = torch.where(share >= LEAST, share * (turn + 2), -1.0)
    ranked = score.argsort(dim=1, descending=True, stable=True)
    usable = (share >= LEAST).sum(1)
    return torch.stack([_spread(order, int(n), count) for order, n in zip(ranked, usable.tolist(), strict=True)])


def _spread(order: Tensor, usable: int, count: int) -> Tensor:
    """``count`` of the first ``usable`` entries: the first half densely, the rest evenly; -1 where there are fewer."""
    if usable <= count:
        return torch.cat((order[:usable], order.new_full((count - usable,), -1)))
    dense = count // 2
    rest = torch.linspace(dense, usable - 1, count - dense, device=order.device).round().long()
    return torch.cat((order[:dense], order[rest]))
