"""Scene of the renderer benchmarks: a box-shaped room covered with pixel-sized Gaussians, seen from inside.

It imitates the output of a feed-forward model: one flat Gaussian per source pixel, slightly off the surface, slightly
misaligned, with varied size and opacity. Every ray passes through several of them. True depth has a closed form.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.geometry.cameras import invert_rigid, ray_directions
from vg2gt.geometry.rotations import matrix_to_quat
from vg2gt.geometry.spherical_harmonics import rgb_to_sh
from vg2gt.types import Cameras, Gaussians

ROOM = (4.2, 2.6, 3.4)  # metres: x, height (y down), z
SOURCES = 8


def room_cameras(views: int, size: tuple[int, int]) -> Cameras:
    """Returns cameras ``[1, views]`` on a line that look at the room's far corner."""
    height, width = size
    poses = []
    for index in range(views):
        step = index / max(views - 1, 1)
        eye = torch.tensor([0.6 + 0.5 * step, 1.3 - 0.2 * step, 0.5 + 0.9 * step])
        forward = F.normalize(torch.tensor([3.6, 1.5, 2.0 + 0.8 * step]) - eye, dim=0)
        right = F.normalize(torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]), forward), dim=0)
        rotation = torch.stack((right, torch.linalg.cross(forward, right), forward))
        pose = torch.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eye
        poses.append(pose)
    focal = 0.8 * width
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Cameras(torch.stack(poses)[None], intrinsics.expand(1, views, 3, 3).clone(), size)


def true_depth(cameras: Cameras) -> Tensor:
    """Returns the depth of the room's walls ``[1, V, H, W]``."""
    rays = ray_directions(cameras.intrinsics, cameras.size)
    return _wall(cameras, rays)[0]


def _wall(cameras: Cameras, rays: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Depth ``[1, V, ...]``, point and inward normal ``[1, V, ..., 3]`` where camera rays hit the walls."""
    to_world = invert_rigid(cameras.world_to_camera)
    extra = (1,) * (rays.dim() - 3)
    origin = to_world[..., :3, 3].reshape(*rays.shape[:2], *extra, 3)
    direction = (to_world[..., :3, :3].reshape(*rays.shape[:2], *extra, 3, 3) @ rays[..., None])[..., 0]
    room = torch.tensor(ROOM)
    distance = torch.where(direction > 0, room - origin, -origin) / direction
    depth, axis = distance.min(-1)
    normal = -F.one_hot(axis, 3) * direction.sign()
    return depth, origin + depth[..., None] * direction, normal


def room_gaussians(count: int, size: tuple[int, int], sigma: float = 1.0, seed: int = 0) -> Gaussians:
    """Returns Gaussians at random pixels of 8 source views.

    Args:
        count: number of Gaussians.
        size: size of the source views ``(height, width)``.
        sigma: mean scale in source pixels.
        seed: random seed.
    """
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    cameras = room_cameras(SOURCES, size)
    height, width = size
    per_view = -(-count // SOURCES)
    pixels = torch.rand(1, SOURCES, per_view, 2, generator=generator) * torch.tensor([width, height])
    focal, center = cameras.intrinsics[0, 0, 0, 0], cameras.intrinsics[0, 0, [0, 1], [2, 2]]
    rays = F.pad((pixels - center) / focal, (0, 1), value=1.0)
    depth, point, facing = (tensor.flatten(0, 2)[:count] for tensor in _wall(cameras, rays))
    third = F.normalize(facing + 0.15 * normal(count, 3), dim=-1)
    first = F.normalize(torch.linalg.cross(third, normal(count, 3)), dim=-1)
    axes = torch.stack((first, torch.linalg.cross(third, first), third), -1)
    scales = (sigma * depth / focal)[:, None] * torch.exp(0.25 * normal(count, 3)) * torch.tensor([1.0, 1.0, 0.25])
    colors = 0.5 + 0.4 * torch.sin(point @ torch.tensor([[3.0, 1, 2], [1, 4, 1], [2, 2, 5]])) + 0.03 * normal(count, 3)
    return Gaussians(
        means=point + facing * 0.003 * normal(count, 1),
        quats=matrix_to_quat(axes),
        scales=scales,
        opacities=torch.sigmoid(0.8 + 1.2 * normal(count)),
        sh=rgb_to_sh(colors)[:, None],
        batch=torch.zeros(count, dtype=torch.int64),
    )
