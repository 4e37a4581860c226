"""Position embeddings, including rotary ones, as dense products so that sizes stay dynamic in an export."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Literal, ParamSpec, TypeVar

import torch
from torch import Tensor

from vg2gt.geometry.precision import full_precision

Resampling = Literal["size", "scale"]
Arguments = ParamSpec("Arguments")
Table = TypeVar("Table")


def remembered(make: Callable[Arguments, Table]) -> Callable[Arguments, Table]:
    """Keeps the last tables made from sizes, dtype and device; an export, whose sizes are free, makes its own."""
    # tables first made in inference mode must not be inference tensors, as a trained network saves them for backward
    kept = lru_cache(maxsize=32)(torch.inference_mode(False)(make))

    @wraps(make)
    def table(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Table:
        return (make if torch.compiler.is_compiling() else kept)(*args, **kwargs)

    return table


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
    weights = _resize_weights(side, grid, resampling, embedding.dtype, embedding.device)
    values = embedding.unflatten(0, (side, side))
    with full_precision(embedding):
        return torch.einsum("hy,wx,yxc->hwc", weights[0], weights[1], values).flatten(0, 1)


@remembered
def _resize_weights(
    side: int, grid: tuple[int, int], resampling: Resampling, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Weights ``[rows, side]`` and ``[columns, side]`` of :func:`resize_position_embedding`."""
    rows, columns = (torch.ones(size, device=device, dtype=dtype).cumsum(0) - 0.5 for size in grid)
    if resampling == "size":
        return _antialiased_weights(rows, side), _antialiased_weights(columns, side)
    # Compare as tensors: a Python comparison would fix the sizes in an export.
    native = (rows[-1] + 0.5 == side) & (columns[-1] + 0.5 == side)
    offset = torch.where(native, 0.0, 0.1)
    return _clamped_weights(rows, offset, side), _clamped_weights(columns, offset, side)


def size_tensor(size: tuple[int, int], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Returns ``size`` as a tensor ``[2]`` without reading its values, which would fix them in an export."""
    return torch.stack([torch.full((), length, dtype=dtype, device=device) for length in size])


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


def uv_embedding(
    channels: int, size: tuple[int, int], image_size: tuple[int, int], weight: float, like: Tensor
) -> Tensor:
    """Returns a sine-cosine embedding ``[channels, h, w]`` of normalised image coordinates.

    Coordinates are those of pixel centres, normalised so that half the diagonal of ``image_size`` is 1. Wavelengths
    grow geometrically up to nearly 100 times the shortest.

    Args:
        channels: number of channels, a multiple of 4; half of them for each axis.
        size: size ``(h, w)`` of the embedding.
        image_size: image ``(height, width)``.
        weight: factor on all values.
        like: tensor whose dtype and device to use.
    """
    # Waves are constant along the other axis: compute them once, then expand.
    waves = _uv_waves(channels, size, image_size, weight, like.dtype, like.device)
    return torch.cat([wave.expand(-1, *size) for wave in waves])


@remembered
def _uv_waves(
    channels: int,
    size: tuple[int, int],
    image_size: tuple[int, int],
    weight: float,
    dtype: torch.dtype,
    device: torch.device,
) -> list[Tensor]:
    """Waves ``[channels / 2, 1, w]`` and ``[channels / 2, h, 1]`` of :func:`uv_embedding`."""
    extent = size_tensor(image_size, dtype, device).double()
    y_extent, x_extent = (extent / extent.norm()).unbind()
    y, x = (
        (2 * torch.arange(length, device=device, dtype=torch.float64) + 1) / length - 1  # pixel centres
        for length in size
    )
    quarter = channels // 4
    omega = 100.0 ** (-torch.arange(quarter, device=device, dtype=torch.float64) / quarter)
    columns, rows = omega[:, None, None] * (x * x_extent), omega[:, None, None] * (y * y_extent)[:, None]
    return [weight * torch.cat((phase.sin(), phase.cos())).to(dtype) for phase in (columns, rows)]


Rotary = tuple[Tensor, Tensor]
"""Cosines and signed sines of a rotary embedding, each ``[..., N, head_dim]``, for :func:`rotate`."""


def grid_positions(height: int, width: int, device: torch.device) -> Tensor:
    """Returns patch positions ``[height * width, 2]`` as (y, x), row major, starting at 0."""
    y = torch.arange(height, device=device, dtype=torch.float32)
    x = torch.arange(width, device=device, dtype=torch.float32)
    return torch.stack((y[:, None].expand(height, width), x[None].expand(height, width)), -1).flatten(0, 1)


def rotary_2d(positions: Tensor, head_dim: int, base: float = 100.0) -> Rotary:
    """Returns rotary embedding tables of 2D positions: the first half of the channels encodes y, the second x.

    Args:
        positions: ``[..., N, 2]`` as (y, x).
        head_dim: channels of one attention head, a multiple of 4.
        base: base of the wavelengths; channel pair i of each half rotates by ``position * base ** (-4 i / head_dim)``.

    Returns:
        Tables in float32.
    """
    quarter = head_dim // 4
    exponents = torch.arange(quarter, device=positions.device, dtype=torch.float32) / quarter
    angles = positions[..., None] * base**-exponents  # [..., N, 2, head_dim / 4]
    cos, sin = angles.cos(), angles.sin()
    return torch.cat((cos, cos), -1).flatten(-2), torch.cat((-sin, sin), -1).flatten(-2)


def rotate(features: Tensor, rotary: Rotary) -> Tensor:
    """Applies :func:`rotary_2d` tables to queries or keys ``[..., N, head_dim]``, in the features' dtype."""
    cos, sin = (table.to(features.dtype) for table in rotary)
    a, b, c, d = features.chunk(4, -1)
    return features * cos + torch.cat((b, a, d, c), -1) * sin
