"""Position embeddings, including rotary ones, as dense products so that sizes stay dynamic in an export."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

from vg2gt.geometry.precision import full_precision

Resampling = Literal["size", "scale"]


def resize_position_embedding(embedding: Tensor, grid: tuple[int, int], resampling: Resampling) -> Tensor:
    """Resizes a square position embedding bicubically to a patch grid, as one matrix product per axis.

    Args:
        embedding: ``[side * side, C]``, row major.
        grid: target ``(rows, columns)``.
        resampling: ``size`` resamples by the ratio of the sizes with antialiasing (VGGT). ``scale`` resamples by the
            scale factor ``(n + 0.1) / side`` without antialiasing, and leaves the native grid unchanged (DA3).

    Returns:
        ``[rows * columns, C]``.
    """
    side = math.isqrt(int(embedding.shape[0]))
    rows, columns = (torch.ones(size, device=embedding.device, dtype=embedding.dtype).cumsum(0) - 0.5 for size in grid)
    if resampling == "size":
        weights = [_antialiased_weights(centers, side) for centers in (rows, columns)]
    else:
        # Compare as tensors: a Python comparison would fix the sizes in an export.
        native = (rows[-1] + 0.5 == side) & (columns[-1] + 0.5 == side)
        offset = torch.where(native, 0.0, 0.1)
        weights = [_clamped_weights(centers, offset, side) for centers in (rows, columns)]
    values = embedding.unflatten(0, (side, side))
    with full_precision(embedding):
        return torch.einsum("hy,wx,yxc->hwc", weights[0], weights[1], values).flatten(0, 1)


def size_tensor(size: tuple[int, int], like: Tensor) -> Tensor:
    """Returns ``size`` as a tensor ``[2]`` without reading its values, which would fix them in an export."""
    return torch.stack([torch.full((), length, dtype=like.dtype, device=like.device) for length in size])


def _cubic(distance: Tensor, a: float) -> Tensor:
    """Keys' cubic convolution kernel."""
    x = distance.abs()
    near = ((a + 2) * x - (a + 3)) * x * x + 1
    far = ((a * x - 5 * a) * x + 8 * a) * x - 4 * a
    return torch.where(x <= 1, near, torch.where(x < 2, far, 0.0))


def _antialiased_weights(centers: Tensor, side: int) -> Tensor:
    """Weights ``[n, side]`` of a kernel (a = -1/2) that widens when downsampling and is truncated at the border."""
    scale = side / (centers[-1] + 0.5)
    sources = torch.arange(side, device=centers.device, dtype=centers.dtype) + 0.5
    weights = _cubic((sources - centers[:, None] * scale) / scale.clamp_min(1), a=-0.5)
    return weights / weights.sum(1, keepdim=True)


def _clamped_weights(centers: Tensor, offset: Tensor, side: int) -> Tensor:
    """Weights ``[n, side]`` of a fixed kernel (a = -3/4) over a border-replicated source."""
    positions = centers * (side / (centers[-1] + 0.5 + offset)) - 0.5
    sources = torch.arange(-2, side + 2, device=centers.device, dtype=centers.dtype)
    weights = _cubic(sources - positions[:, None], a=-0.75)
    first = weights[:, :3].sum(1, keepdim=True)
    last = weights[:, -3:].sum(1, keepdim=True)
    return torch.cat((first, weights[:, 3:-3], last), 1)


def uv_embedding(channels: int, size: tuple[int, int], image_size: tuple[int, int], like: Tensor) -> Tensor:
    """Returns a sine-cosine embedding ``[channels, h, w]`` of normalised image coordinates.

    Coordinates are those of pixel centres, normalised so that half the diagonal of ``image_size`` is 1. Wavelengths
    grow geometrically up to nearly 100 times the shortest.

    Args:
        channels: number of channels, a multiple of 4; half of them for each axis.
        size: size ``(h, w)`` of the embedding.
        image_size: image ``(height, width)``.
        like: tensor whose dtype and device to use.
    """
    extent = size_tensor(image_size, like).double()
    y_extent, x_extent = (extent / extent.norm()).unbind()
    y, x = (
        (2 * torch.arange(length, device=like.device, dtype=torch.float64) + 1) / length - 1  # pixel centres
        for length in size
    )
    quarter = channels // 4
    omega = 100.0 ** (-torch.arange(quarter, device=like.device, dtype=torch.float64) / quarter)
    columns, rows = omega[:, None, None] * (x * x_extent), omega[:, None, None] * (y * y_extent)[:, None]
    # Waves are constant along the other axis: compute them once, then expand.
    waves = [torch.cat((phase.sin(), phase.cos())).to(like.dtype) for phase in (columns, rows)]
    return torch.cat([wave.expand(-1, *size) for wave in waves])


Rotary = tuple[Tensor, Tensor]
"""Cosines and sines of a rotary embedding, each ``[..., N, head_dim]``."""


def grid_positions(height: int, width: int, like: Tensor) -> Tensor:
    """Returns patch positions ``[height * width, 2]`` as (y, x), row major, starting at 0."""
    y = torch.arange(height, device=like.device, dtype=torch.float32)
    x = torch.arange(width, device=like.device, dtype=torch.float32)
    return torch.stack((y[:, None].expand(height, width), x[None].expand(height, width)), -1).flatten(0, 1)


def rotary_2d(positions: Tensor, head_dim: int, base: float = 100.0) -> Rotary:
    """Returns rotary embedding tables of 2D positions: the first half of the channels encodes y, the second x.

    Args:
        positions: ``[..., N, 2]`` as (y, x).
        head_dim: channels of one attention head, a multiple of 4.
        base: base of the wavelengths; channel pair i of each half rotates by ``position * base ** (-4 i / head_dim)``.

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
