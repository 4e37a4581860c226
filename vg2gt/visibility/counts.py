"""Counts the other views that agree with the depth of a pixel, and those that look through its point.

Let ``r`` be the depth of a pixel's point in another view, divided by that view's own depth. The view *agrees* if
``|r - 1| < tolerance`` and looks *through* the point if ``r < 1 - margin``; otherwise the point is *hidden* from it.
Of the four pixels around the projection, one must agree, or all must look through.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from vg2gt.geometry.cameras import compose, invert_rigid, ray_directions, transform_points
from vg2gt.kernels.threads import parallel_for
from vg2gt.kernels.view_counts import HEAVIEST, NEAREST, count_view
from vg2gt.types import Cameras, TensorRecord


@dataclass(frozen=True)
class ViewCounts(TensorRecord):
    """Numbers of other views per pixel, or sums of their weights, as floats.

    Attributes:
        agree: ``[V, H, W]`` views that see a surface at the pixel's point.
        through: ``[V, H, W]`` views that look through the point at something behind it.
        hidden: ``[V, H, W]`` views that do neither, mostly because something is in front of the point.
    """

    agree: Tensor
    through: Tensor
    hidden: Tensor


@torch.no_grad()
def count_views(
    depth: Tensor, cameras: Cameras, partners: Tensor, tolerance: float, margin: float, weighted: bool = False
) -> ViewCounts:
    """Counts for each pixel the partners of its view that agree or look through, for one scene.

    Args:
        depth: ``[V, H, W]`` z-depth, 0 = none.
        cameras: cameras of the views (B = 1), in the unit of the depth.
        partners: ``[V, K]`` int64, views that each view is compared with; -1 = none.
        tolerance: relative depth difference below which views agree.
        margin: relative depth difference above which a view looks through a point.
        weighted: weight a view by the pixel's depth divided by the point's depth in that view, at most 2: the error of
            depth grows with the distance. False: every view counts 1.

    Returns:
        The counts; 0 for pixels without depth.
    """
    if depth.device.type == "cpu":
        return _count_compiled(depth, cameras, partners, tolerance, margin, weighted)
    return count_views_reference(depth, cameras, partners, tolerance, margin, weighted)


def count_views_reference(
    depth: Tensor, cameras: Cameras, partners: Tensor, tolerance: float, margin: float, weighted: bool = False
) -> ViewCounts:
    """:func:`count_views` in plain torch, for any device and precision."""
    height, width = depth.shape[1:]
    pose, intrinsics = cameras.world_to_camera[0].to(depth), cameras.intrinsics[0].to(depth)
    rays = ray_directions(intrinsics, (height, width))  # [V, H, W, 3]
    known = depth > 0
    sums = ViewCounts(*(torch.zeros_like(depth) for _ in range(3)))
    for other in partners.T:  # one partner of each view
        # pixels to the partner's image: column and row [V, H, W], depth z [V, H, W]
        there = other.clamp(min=0)
        motion = compose(pose[there], invert_rigid(pose))  # [V, 4, 4]
        points = transform_points(motion[None], (rays * depth[..., None])[None])[0]
        z = points[..., 2]
        seen = intrinsics[there][:, None, None]
        safe = z.clamp(min=NEAREST)
        column = points[..., 0] / safe * seen[..., 0, 0] + seen[..., 0, 2]
        row = points[..., 1] / safe * seen[..., 1, 1] + seen[..., 1, 2]
        inside = known & (z > NEAREST) & (other >= 0)[:, None, None]
        inside &= (column > -0.5) & (column < width - 0.5) & (row > -0.5) & (row < height - 0.5)
        # compare with the partner's depth at the four surrounding pixels
        left, top = column.floor(), row.floor()
        agree, through, says = torch.zeros_like(inside), inside.clone(), torch.zeros_like(inside)
        for down in (0, 1):
            for right in (0, 1):
                u = (left + right).clamp(0, width - 1).nan_to_num().long()
                v = (top + down).clamp(0, height - 1).nan_to_num().long()
                found = depth[there[:, None, None], v, u]
                ratio = z / found.clamp(min=NEAREST)
                valid = inside & (found > 0)
                agree |= valid & ((ratio - 1).abs() < tolerance)
                through &= valid & (ratio < 1 - margin)
                says |= valid
        hidden = says & ~agree & ~through
        weight = (depth / safe).clamp(max=HEAVIEST) if weighted else 1.0
        for total, chosen in zip((sums.agree, sums.through, sums.hidden), (agree, through, hidden), strict=True):
            total += chosen * weight
    return sums


def _count_compiled(
    depth: Tensor, cameras: Cameras, partners: Tensor, tolerance: float, margin: float, weighted: bool
) -> ViewCounts:
    pose = cameras.world_to_camera[0].double()
    intrinsics = cameras.intrinsics[0].double()
    there = partners.clamp(min=0)
    motion = compose(pose[there], invert_rigid(pose)[:, None])[..., :3, :]  # [V, K, 3, 4]
    # one matrix from homogeneous pixel coordinates times depth to those of the partner
    to_pixel = intrinsics[there] @ motion  # [V, K, 3, 4]
    back = torch.linalg.inv(intrinsics)[:, None]
    matrix = torch.cat((to_pixel[..., :3] @ back, to_pixel[..., 3:]), -1).float().contiguous().numpy()
    maps = depth.detach().float().contiguous().numpy()
    sums = [np.zeros(maps.shape, np.float32) for _ in range(3)]
    inputs = (maps, partners.contiguous().numpy(), matrix, np.float32(tolerance), np.float32(margin), weighted)
    parallel_for(range(len(maps)), lambda view: count_view(view, *inputs, *sums))
    return ViewCounts(*(torch.from_numpy(total).to(depth.dtype) for total in sums))


@torch.no_grad()
def count_points(
    points: Tensor, depth: Tensor, cameras: Cameras, tolerance: float, margin: float
) -> tuple[Tensor, Tensor]:
    """Counts the views that agree with world points, and the views that look through them.

    Args:
        points: ``[N, 3]`` in the world frame of the cameras.
        depth: ``[V, H, W]`` z-depth of the views, 0 = none.
        cameras: cameras of the views (B = 1).
        tolerance: relative depth difference below which a view agrees.
        margin: relative depth difference above which a view looks through a point.

    Returns:
        Numbers of views that agree and that look through, ``[N]`` int64 each.
    """
    agree, through = (torch.zeros(len(points), dtype=torch.int64, device=points.device) for _ in range(2))
    for view in range(len(depth)):
        one = slice(view, view + 1)
        pose, intrinsics = cameras.world_to_camera[0, one], cameras.intrinsics[0, one]
        ratio, known = depth_ratio(points[None], depth[one], pose.to(points), intrinsics.to(points))
        agree += (known & ((ratio - 1).abs() < tolerance))[0]
        through += (known & (ratio < 1 - margin))[0]
    return agree, through


def depth_ratio(points: Tensor, depth: Tensor, to_camera: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the depth of points in each view, divided by the view's own depth at the nearest pixel.

    Args:
        points: ``[V, P, 3]``, in the source frame of ``to_camera``.
        depth: ``[V, H, W]`` z-depth of the views, 0 = none.
        to_camera: ``[V, 4, 4]`` rigid transforms to the views' camera frames.
        intrinsics: ``[V, 3, 3]`` in pixels.

    Returns:
        The ratio ``[V, P]``, and ``[V, P]`` bool: whether the point projects to a pixel with depth.
    """
    height, width = depth.shape[1:]
    seen = transform_points(to_camera[None], points[None])[0]
    z = seen[..., 2]
    focal, center = intrinsics[:, [0, 1], [0, 1]], intrinsics[:, :2, 2]
    pixel = seen[..., :2] / z[..., None].clamp(min=NEAREST) * focal[:, None] + center[:, None]
    column, row = pixel.round().unbind(-1)
    inside = (z > NEAREST) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    index = row.clamp(0, height - 1).nan_to_num().long() * width + column.clamp(0, width - 1).nan_to_num().long()
    found = depth.flatten(1).gather(1, index)
    return z / found.clamp(min=NEAREST), inside & (found > 0)
