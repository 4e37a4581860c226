"""Two-dimensional rotary position embedding, computed from positions each time: no caches, so that it exports."""

from __future__ import annotations

import torch
from torch import Tensor

Rotary = tuple[Tensor, Tensor]
"""Cosines and sines, each ``[..., N, head_dim]``."""


def grid_positions(height: int, width: int, like: Tensor) -> Tensor:
    """Integer patch positions ``[height * width, 2]`` as (y, x), row major, starting at 0."""
    y = torch.arange(height, device=like.device, dtype=torch.float32)
    x = torch.arange(width, device=like.device, dtype=torch.float32)
    return torch.stack((y[:, None].expand(height, width), x[None].expand(height, width)), -1).flatten(0, 1)


def rotary_2d(positions: Tensor, head_dim: int, base: float = 100.0) -> Rotary:
    """Rotation tables of 2D positions: the first half of the channels turns with y, the second with x.

    Args:
        positions: ``[..., N, 2]`` as (y, x).
        head_dim: channels of one attention head, a multiple of 4.
        base: wavelength base; channel pair i of each half turns by ``position * base ** (-4 i / head_dim)``.

    Returns:
        Cosines and sines ``[..., N, head_dim]`` in float32.
    """
    quarter = head_dim // 4
    exponents = torch.arange(quarter, device=positions.device, dtype=torch.float32) / quarter
    angles = positions[..., None] * base**-exponents  # [..., N, 2, head_dim / 4]
    angles = torch.cat((angles, angles), -1).flatten(-2)
    return angles.cos(), angles.sin()


def rotate(features: Tensor, rotary: Rotary) -> Tensor:
    """Applies :func:`rotary_2d` tables to queries or keys ``[..., N, head_dim]``, in the features' dtype."""
    cos, sin = (table.to(features.dtype) for table in rotary)
    a, b, c, d = features.chunk(4, -1)
    return features * cos + torch.cat((-b, a, -d, c), -1) * sin
