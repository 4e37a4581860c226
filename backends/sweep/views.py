"""Geometry of the cameras, and the choice of source views from them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from vg2gt.geometry.cameras import pixel_grid, resize_intrinsics

SOURCES = 6  # of a view; with three of them at 1/4 and 1/2, unseen rooms have 12 % more error
_SCORED = (0.7, 30.0)  # near and far, in baselines, of the points whose visibility scores the sources
_LEAST_BASELINE = 0.02  # in extents of the cameras
_GRID = (5, 9)  # rays per view for measuring overlap
_DEPTHS = 5  # planes between near and far for measuring overlap
# baseline over depth: too little parallax below the first, too different views above the second
_LEAST_PARALLAX, _MOST_PARALLAX = 0.08, 0.5
_ONE_PLACE = 0.015  # cameras nearer than this count as in one place, in extents (camera_extent)
_ONE_CAMERA = 1e-3  # extent without the farthest camera, relative to that with it, below which the latter counts
_SAME_DIRECTION = math.cos(math.radians(5))
_SEEN_AGAIN = 0.4  # factor on a point's score for every source that already sees it


def rays(intrinsics: Tensor, size: tuple[int, int]) -> Tensor:
    """Returns unit-z rays ``[V, 3, h * w]`` through the pixel centres.

    Args:
        intrinsics: ``[V, 3, 3]``.
        size: image ``(height, width)``.
    """
    u, v = pixel_grid(*size, intrinsics).unbind(-1)
    pixels = torch.stack((u.flatten(), v.flatten(), torch.ones_like(u).flatten()))
    return torch.linalg.inv(intrinsics) @ pixels


def relative_poses(world_to_camera: Tensor, sources: Tensor) -> Tensor:
    """Returns the transforms ``[V, n, 4, 4]`` from every view to its sources (indices ``[V, n]``)."""
    return world_to_camera[sources] @ torch.linalg.inv(world_to_camera)[:, None]


def baselines(world_to_camera: Tensor) -> Tensor:
    """Returns the unit of length of each view's planes ``[V]``: the median distance to its nearest cameras.

    If that is too short, because the camera rested, only cameras farther away count.

    Args:
        world_to_camera: ``[V, 4, 4]``, not all in one place.
    """
    distances = camera_distances(world_to_camera)
    least = _LEAST_BASELINE * camera_extent(distances)
    others = distances.fill_diagonal_(torch.inf)
    count = min(SOURCES, len(others) - 1)
    nearest = others.sort(1).values[:, :count].median(1).values
    apart = others.masked_fill(others < least, torch.inf).sort(1).values[:, :count]
    middle = (apart.isfinite().sum(1, keepdim=True) - 1) // 2
    return torch.where(nearest < least, apart.gather(1, middle)[:, 0], nearest)


def sources_of(
    world_to_camera: Tensor,
    intrinsics: Tensor,
    size: tuple[int, int],
    count: int = SOURCES,
    noise: Tensor | None = None,
) -> Tensor:
    """Chooses the sources of the views of one scene from the cameras alone.

    Arguments and result as in :func:`choose_sources`, whose near and far depend on the views' :func:`baselines`.
    """
    searched = baselines(world_to_camera)[:, None] * world_to_camera.new_tensor(_SCORED)
    return choose_sources(world_to_camera, intrinsics, size, searched, count, noise)


def choose_sources(
    world_to_camera: Tensor,
    intrinsics: Tensor,
    size: tuple[int, int],
    depth_range: Tensor,
    count: int,
    noise: Tensor | None = None,
) -> Tensor:
    """Chooses the source views that every view is matched with, greedily.

    The score of a source is its overlap with the view between near and far, times a reward for parallax that decreases
    again for wide baselines. Points that already chosen sources see count less. Views from the same place have no
    parallax and are never sources of each other, and of those that show the same only one is a source. A view with too
    few sources has its best one several times.

    Args:
        world_to_camera: ``[V, 4, 4]``.
        intrinsics: ``[V, 3, 3]`` in pixels.
        size: image ``(height, width)``.
        depth_range: near and far, ``[2]`` or ``[V, 2]``.
        count: number of sources per view; at most V - 1 are returned.
        noise: ``[V, V]``, added to the logarithms of the scores (training).

    Returns:
        Indices of the sources ``[V, n]``, best first.
    """
    views = len(world_to_camera)
    inside, poses, depths = _seen_by(world_to_camera, intrinsics, size, depth_range)
    # reward for parallax: [V, s]
    distances = poses[..., :3, 3].norm(dim=-1)
    parallax = distances / depths[:, _DEPTHS // 2, None]
    reward = parallax / (parallax + _LEAST_PARALLAX) / (1 + (parallax / _MOST_PARALLAX) ** 2)
    if noise is not None:
        reward = reward * torch.exp(noise)
    seen = inside.float()  # [V, s, z p]
    left = torch.ones_like(seen[:, 0])  # [V, z p] weights of the points for the next source
    together = distances <= _ONE_PLACE * camera_extent(distances)
    together |= torch.eye(views, dtype=torch.bool, device=reward.device)
    cosine = (torch.einsum("vij,sij->vs", world_to_camera[:, :3, :3], world_to_camera[:, :3, :3]) - 1) / 2
    copies = together & (cosine > _SAME_DIRECTION)
    reward = reward.masked_fill(together, -torch.inf)
    chosen, everyone = [], torch.arange(views, device=seen.device)
    for _ in range(min(count, views - 1)):
        score = (seen * left[:, None]).mean(-1).clamp_min(1e-6) * reward  # [V, s]
        most, best = score.max(1)
        chosen.append(torch.where(most.isfinite(), best, chosen[0]) if chosen else best)
        best = chosen[-1]
        left = left * torch.where(seen[everyone, best] > 0, _SEEN_AGAIN, 1.0)
        reward = reward.masked_fill(copies[best], -torch.inf)
    return torch.stack(chosen, 1)


def _seen_by(
    world_to_camera: Tensor, intrinsics: Tensor, size: tuple[int, int], depth_range: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Tests which points between near and far of every view V are inside which other view s.

    Returns:
        Whether they are ``[V, s, z p]``, transforms from every view to every other ``[V, s, 4, 4]``, and the depths of
        the points ``[V, z]``.
    """
    views = len(world_to_camera)
    scaled = resize_intrinsics(intrinsics, _GRID[1] / size[1], _GRID[0] / size[0])
    near, far = depth_range.expand(views, 2).unsqueeze(-1).unbind(1)  # [V, 1]
    steps = torch.linspace(0, 1, _DEPTHS + 2, device=near.device)[1:-1]
    depths = 1 / (1 / far + steps * (1 / near - 1 / far))  # [V, z]
    # sample points of every view, projected into every possible source
    points = rays(scaled, _GRID)[:, None] * depths[..., None, None]  # [V, z, 3, p]
    everyone = torch.arange(views, device=near.device).expand(views, views)
    poses = relative_poses(world_to_camera, everyone)
    seen = torch.einsum("vsij,vzjp->vszip", poses[..., :3, :3], points) + poses[:, :, None, :3, 3:]
    pixels = torch.einsum("sij,vszjp->vszip", scaled, seen)
    z = pixels[..., 2, :]
    u, v = (pixels[..., axis, :] / z.clamp_min(1e-6) for axis in (0, 1))
    inside = (z > 0) & (u > -0.5) & (u < _GRID[1] - 0.5) & (v > -0.5) & (v < _GRID[0] - 0.5)
    return inside.flatten(2), poses, depths


def camera_distances(world_to_camera: Tensor) -> Tensor:
    """Returns the distances ``[V, V]`` between the centres of cameras ``[V, 4, 4]``."""
    centers = torch.linalg.inv(world_to_camera)[:, :3, 3]
    return torch.cdist(centers, centers, compute_mode="donot_use_mm_for_euclid_dist")  # mm loses small distances


def camera_extent(distances: Tensor) -> Tensor:
    """Returns how far the cameras are apart: to the farthest but one, in the median over the views.

    One camera far from all others, such as one that was placed wrongly, does not count unless the rest is in one place.

    Args:
        distances: ``[V, V]`` between the cameras.
    """
    views = len(distances)
    within = distances.sort(1).values[:, -2 if views > 3 else -1].median()
    whole = distances.max()
    return torch.where(within < _ONE_CAMERA * whole, whole, within)
