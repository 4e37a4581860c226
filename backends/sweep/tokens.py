"""Patch tokens of the plane sweep: attention of 8x8 patches within and across views, and their positions."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from backends.sweep.views import rays
from vg2gt.geometry.cameras import resize_intrinsics

PATCH = 8
DIM = 128
TAPS = 2  # outputs of the last two blocks
_WAVENUMBERS = (1.5, 4.0, 10.0)  # of 3D position encodings, in units of one over the unit of length
_IMAGE_WAVES = 8
POSITION_CHANNELS = 3 + 3 + 6 * len(_WAVENUMBERS) + 4 * _IMAGE_WAVES


class TokenBlock(nn.Module):
    """Pre-norm transformer block; keys and values are pooled tokens of its own view, or of all (``across``)."""

    def __init__(self, dim: int, heads: int, across: bool, pool: int = 2) -> None:
        super().__init__()
        self.heads, self.across, self.pool = heads, across, pool
        self.norm, self.norm_mlp = nn.LayerNorm(dim), nn.LayerNorm(dim)
        self.query, self.key_value, self.out = nn.Linear(dim, dim), nn.Linear(dim, 2 * dim), nn.Linear(dim, dim)
        self.mlp = nn.Sequential(nn.Linear(dim, 3 * dim), nn.GELU(), nn.Linear(3 * dim, dim))

    def forward(self, x: Tensor, position: Tensor, grid: tuple[int, int]) -> Tensor:
        """Maps tokens ``[V, P, dim]`` to the same shape.

        Args:
            x: tokens ``[V, P, dim]``.
            position: position embeddings ``[V, P, dim]``.
            grid: patches per axis.
        """
        views, patches, dim = x.shape
        placed = self.norm(x) + position
        query = self.query(placed)
        keys = F.avg_pool2d(placed.mT.unflatten(-1, grid), self.pool, ceil_mode=True).flatten(2).mT
        if self.across:
            query, keys = query.reshape(1, -1, dim), keys.reshape(1, -1, dim)
        parts = (query, *self.key_value(keys).chunk(2, -1))
        split = [part.unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in parts]  # [., heads, P, dim/heads]
        attended = F.scaled_dot_product_attention(*split).transpose(1, 2).flatten(2).reshape(views, patches, dim)
        x = x + self.out(attended)
        return x + self.mlp(self.norm_mlp(x))


def attend(blocks: nn.ModuleList, tokens: Tensor, position: Tensor, grid: tuple[int, int]) -> tuple[Tensor, ...]:
    """Runs blocks one after the other; returns the outputs of all. Arguments as in :meth:`TokenBlock.forward`."""
    outputs = []
    for block in blocks:
        tokens = block(tokens, position, grid)
        outputs.append(tokens)
    return tuple(outputs)


def patch_places(
    depth: Tensor,
    world_to_camera: Tensor,
    intrinsics: Tensor,
    unit: Tensor,
    size: tuple[int, int],
) -> Tensor:
    """Encodes the positions of patches: 3D point and ray in the first view's frame, and position in the image.

    Args:
        depth: depth of the patches ``[V, P]``.
        world_to_camera: ``[V, 4, 4]``.
        intrinsics: ``[V, 3, 3]``, at image resolution.
        unit: unit of length, a scalar.
        size: patches per axis.

    Returns:
        ``[V, P, POSITION_CHANNELS]``.
    """
    pose = world_to_camera[:1] @ torch.linalg.inv(world_to_camera)
    ray = rays(resize_intrinsics(intrinsics, 1 / PATCH, 1 / PATCH), size)  # [V, 3, P]
    point = (pose[:, :3, :3] @ (ray * depth[:, None]) + pose[:, :3, 3:]) / unit
    direction = F.normalize(pose[:, :3, :3] @ ray, dim=1)
    waves = [wave(point * number) for number in _WAVENUMBERS for wave in (torch.sin, torch.cos)]
    rows, columns = (torch.linspace(0, 1, steps, device=depth.device) for steps in size)
    axes = torch.stack(torch.meshgrid(rows, columns, indexing="ij")).flatten(1)  # [2, P]
    numbers = math.pi * 2 ** (torch.arange(_IMAGE_WAVES, device=depth.device) / 2)
    phases = (axes[:, None] * numbers[:, None]).flatten(0, 1)  # [2 * waves, P]
    image = torch.cat((phases.sin(), phases.cos())).expand(len(depth), -1, -1)
    return torch.cat((point.clamp(-5, 5), direction, *waves, image), 1).mT
