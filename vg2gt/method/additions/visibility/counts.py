"""How many other views agree with the depth of a pixel, and how many look through its point.

With ``r`` the depth of a pixel's point in another view over that view's own depth, the view *agrees* where ``|r - 1| <
tolerance``, looks *through* the point where ``r < 1 - margin``, and the point is *hidden* from it where ``r`` is
larger. Of the four pixels around the projection one that agrees is enough, and all four must look through.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from vg2gt.geometry.cameras import compose, invert_rigid, ray_directions, transform_points
from vg2gt.kernels.view_counts import NEAREST, count_compiled
from vg2gt.types import Cameras, TensorRecord


@dataclass(frozen=True)
class ViewCounts(TensorRecord):
    """Numbers of other views, as floats.

    Attributes:
        agree: ``[V, H, W]`` views that see a surface where the pixel's point is.
        through: ``[V, H, W]`` views that look through the point at something behind it.
        hidden: ``[V, H, W]`` views that see something in front of the point.
    """

    agree: Tensor
    through: Tensor
    hidden: Tensor


@torch.no_grad()
def count_views(depth: Tensor, cameras: Cameras, partners: Tensor, tolerance: float, margin: float) -> ViewCounts:
    """Counts what the partners of each view say of its pixels, for one scene.

    Args:
        depth: ``[V, H, W]`` z-depth, 0 = none.
        cameras: of the views (B = 1), in the unit of the depth.
        partners: ``[V, K]`` int64 views that each view is compared with; -1 = none.
        tolerance: relative difference of depth up to which views agree.
        margin: relative difference of depth from which on a view looks through a point.

    Returns:
        The numbers; 0 for pixels without depth.
    """
    if depth.device.type == "cpu":
        return _count_compiled(depth, cameras, partners, tolerance, margin)
    return count_views_reference(depth, cameras, partners, tolerance, margin)


def count_views_reference(
    depth: Tensor, cameras: Cameras, partners: Tensor, tolerance: float, margin: float
) -> ViewCounts:
    """:func:`count_views` in plain torch, for any device and precision."""
    height, width = depth.shape[1:]
    pose, intrinsics = cameras.world_to_camera[0].to(depth), cameras.intrinsics[0].to(depth)
    rays = ray_directions(intrinsics, (height, width))  # [V, H, W, 3]
    known = depth > 0
    sums = ViewCounts(*(torch.zeros_like(depth) for _ in range(3)))
    for other in partners.T:  # one partner of each view
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
        for total, chosen in zip((sums.agree, sums.through, sums.hidden), (agree, through, hidden), strict=True):
            total += chosen
    return sums


def _count_compiled(depth: Tensor, cameras: Cameras, partners: Tensor, tolerance: float, margin: float) -> ViewCounts:
    pose = cameras.world_to_camera[0].double()
    intrinsics = cameras.intrinsics[0].double()
    there = partners.clamp(min=0)
    motion = compose(pose[there], invert_rigid(pose)[:, None])[..., :3, :]  # [V, K, 3, 4]
    # From a pixel's homogeneous coordinates times depth to those in the partner's image, in one matrix.
    to_pixel = intrinsics[there] @ motion  # [V, K, 3, 4]
    back = torch.linalg.inv(intrinsics)[:, None]
    matrix = torch.cat((to_pixel[..., :3] @ back, to_pixel[..., 3:]), -1).float().contiguous().numpy()
    maps = depth.detach().float().contiguous().numpy()
    sums = count_compiled(maps, partners.contiguous().numpy(), matrix, tolerance, margin)
    return ViewCounts(*(torch.from_numpy(total).to(depth.dtype) for total in sums))


@torch.no_grad()
def count_points(
    points: Tensor, depth: Tensor, cameras: Cameras, tolerance: float, margin: float
) -> tuple[Tensor, Tensor]:
    """How many views agree with points in space, and how many look through them.

    Args:
        points: ``[N, 3]`` in the world of the cameras.
        depth: ``[V, H, W]`` z-depth of the views, 0 = none.
        cameras: of the views (B = 1).
        tolerance: relative difference of depth up to which a view agrees.
        margin: relative difference of depth from which on a view looks through a point.

    Returns:
        Views that agree and views that look through, ``[N]`` int64 each.
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
    """Depth of points ``[V, P, 3]`` in views over the views' own depth at the nearest pixel.

    Args:
        points: in frames that ``to_camera`` ``[V, 4, 4]`` takes into the views'.
        depth: ``[V, H, W]`` z-depth of the views, 0 = none.
        to_camera: as said.
        intrinsics: ``[V, 3, 3]`` in pixels.

    Returns:
        The ratio ``[V, P]``, and whether the point is in the image where the view has a depth.
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
