"""Far shell: distant Gaussians in the colours of the pixels whose depth no view supports.

Views agree on no depth for sky, surfaces beyond the searched range and distant textureless walls. A shell around all
cameras shows their blurred colours by direction, behind everything else.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.geometry.cameras import camera_centers, ray_directions
from vg2gt.geometry.rotations import matrix_to_quat
from vg2gt.geometry.spherical_harmonics import rgb_to_sh
from vg2gt.types import Cameras, Gaussians

COUNT = 1000  # Gaussians on the full sphere
RADIUS = 20.0  # median depths
FAR = 8.0  # median depths; only the shell is this far from every camera
_BLUR = 1.5  # standard deviation of the colour blur, in spacings of the shell's Gaussians
_PRIOR = 3.0  # pixels of the mean colour added in every direction
WIDTH = 0.6  # standard deviation of each Gaussian in spacings; they overlap without gaps
THIN = 0.02  # thickness relative to the width
OPACITY = 0.95
_RAYS = 60_000  # pixels are subsampled to fewer than twice this number
LEAST = 0.005  # share of unsupported pixels below which there is no shell


@torch.no_grad()
def far_shell(images: Tensor, depth: Tensor, cameras: Cameras, mask: Tensor | None = None) -> Gaussians | None:
    """Builds the shell of one scene from flat Gaussians that face the cameras.

    Args:
        images: ``[V, 3, H, W]`` in [0, 1].
        depth: ``[V, H, W]`` supported z-depth, 0 = none.
        cameras: cameras of the views (B = 1).
        mask: ``[V, H, W]`` in [0, 1]; pixels at or below 0.5 are ignored. None: all count.

    Returns:
        The shell; None if nearly every pixel has a depth, or no pixel has one.
    """
    missing = depth <= 0 if mask is None else (depth <= 0) & (mask > 0.5)
    if missing.float().mean() < LEAST or not (depth > 0).any():
        return None
    # world rays and colours of R pixels without depth: [R, 3]
    rows = missing.flatten().nonzero()[:, 0]
    rows = rows[:: max(1, len(rows) // _RAYS)]
    rays = ray_directions(cameras.intrinsics[0], cameras.size) @ cameras.world_to_camera[0, :, None, :3, :3]
    rays = F.normalize(rays.reshape(-1, 3)[rows], dim=-1)
    colors = images.movedim(1, -1).reshape(-1, 3)[rows]
    # mean colour of the rays around each of N directions
    directions = _fibonacci().to(rays)
    spacing = math.sqrt(4 * math.pi / COUNT)
    total = _PRIOR * F.pad(colors.mean(0, keepdim=True), (0, 1), value=1.0).repeat(COUNT, 1)  # [N, 4]
    for ray, color in zip(rays.split(4096), colors.split(4096), strict=True):
        weight = torch.exp((ray @ directions.T - 1) / (_BLUR * spacing) ** 2)
        total += weight.T @ F.pad(color, (0, 1), value=1.0)
    centers, median = camera_centers(cameras)[0], depth[depth > 0].median()
    extent = (centers - centers.mean(0)).norm(dim=1).max()
    radius = torch.maximum(RADIUS * median, extent + 1.25 * FAR * median)  # far from all cameras of a long walk
    return Gaussians(
        means=centers.mean(0) + radius * directions,
        quats=_facing(directions),
        scales=radius * spacing * WIDTH * directions.new_tensor([1.0, 1.0, THIN]).repeat(COUNT, 1),
        opacities=directions.new_full((COUNT,), OPACITY),
        sh=rgb_to_sh(total[:, :3] / total[:, 3:])[:, None],
        batch=torch.zeros(COUNT, dtype=torch.int64, device=rays.device),
    )


def is_far(gaussians: Gaussians, depth: Tensor, cameras: Cameras) -> Tensor:
    """Returns ``[G]`` bool, true for Gaussians as far from every camera as the shell; args as :func:`far_shell`."""
    known = depth[depth > 0]
    if not len(known):
        return torch.zeros_like(gaussians.batch, dtype=torch.bool)
    return torch.cdist(gaussians.means, camera_centers(cameras)[0]).amin(1) > FAR * known.median()


def _fibonacci() -> Tensor:
    """Returns directions ``[N, 3]`` spread evenly over the sphere."""
    step = torch.arange(COUNT, dtype=torch.float64) + 0.5
    z, angle = 1 - 2 * step / COUNT, math.pi * (1 + math.sqrt(5)) * step
    ring = (1 - z.square()).sqrt()
    return torch.stack((ring * angle.cos(), ring * angle.sin(), z), -1)


def _facing(directions: Tensor) -> Tensor:
    """Returns rotations ``[N, 4]`` whose third axis is the direction."""
    up = directions.new_tensor([[0.0, 1.0, 0.0]]).expand_as(directions)
    first = F.normalize(torch.linalg.cross(up, directions), dim=-1)
    second = torch.linalg.cross(directions, first)
    return matrix_to_quat(torch.stack((first, second, directions), -1))
