"""Dense prediction head (DPT): fuses four token maps, coarse to fine, into one map at image resolution."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

from backends.positions import uv_embedding
from vg2gt.geometry.precision import full_precision
from vg2gt.types import Cameras, Geometry, Tokens

_POSITION_WEIGHT = 0.1
HIDDEN = 32


class _ResidualUnit(nn.Module):
    """Two 3x3 convolutions with ReLU before each, added to x, or to ``relu(x)`` with ``rectified_skip`` (VGGT)."""

    def __init__(self, channels: int, rectified_skip: bool) -> None:
        super().__init__()
        self.rectified_skip = rectified_skip
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Maps ``[N, C, h, w]`` to ``[N, C, h, w]``."""
        rectified = F.relu(x)
        change = self.conv2(F.relu(self.conv1(rectified)))
        return change + (rectified if self.rectified_skip else x)


class _Fusion(nn.Module):
    """Adds a finer map to a coarser one, refines and upsamples the sum."""

    def __init__(self, channels: int, rectified_skip: bool, has_finer: bool = True) -> None:
        super().__init__()
        if has_finer:
            self.resConfUnit1 = _ResidualUnit(channels, rectified_skip)
        self.resConfUnit2 = _ResidualUnit(channels, rectified_skip)
        self.out_conv = nn.Conv2d(channels, channels, 1)

    def forward(self, coarse: Tensor, finer: Tensor | None, size: tuple[int, int]) -> Tensor:
        """Fuses ``[N, C, h, w]`` maps, and resizes the result to ``size``."""
        if finer is not None:
            coarse = coarse + self.resConfUnit1(finer)
        return self.out_conv(upsample(self.resConfUnit2(coarse), size))


def upsample(x: Tensor, size: tuple[int, int]) -> Tensor:
    """Resizes bilinearly, with aligned corners."""
    return F.interpolate(x, size, mode="bilinear", align_corners=True)


def _output_layers(channels: int, out: int) -> nn.Sequential:
    """Returns the output layers: 3x3 convolution, ReLU, 1x1 convolution."""
    return nn.Sequential(nn.Conv2d(channels, HIDDEN, 3, padding=1), nn.ReLU(), nn.Conv2d(HIDDEN, out, 1))


class DPT(nn.Module):
    """Decodes the token maps of four taps into a map at image resolution.

    Args:
        token_dim: channels of the tokens.
        features: channels of the fusion stages.
        out_channels: channels of the four projected maps.
        out: channels of the output.
        patch_size: edge of a patch in pixels.
        rectified_skip: see :class:`_ResidualUnit`.
        normalize: whether to apply a LayerNorm, shared by all taps, to the tokens first.
        position_weight: weight of the sine-cosine position embedding added to the maps; 0 adds none.
        sky: whether to predict sky as one more output channel, from the same fused map.
    """

    def __init__(
        self,
        token_dim: int,
        features: int,
        out_channels: Sequence[int],
        out: int,
        patch_size: int = 14,
        rectified_skip: bool = False,
        normalize: bool = True,
        position_weight: float = _POSITION_WEIGHT,
        sky: bool = False,
    ) -> None:
        super().__init__()
        self.patch_size = patch_size
        self.position_weight = position_weight
        first, second, third, fourth = out_channels
        self.norm = nn.LayerNorm(token_dim, eps=1e-5) if normalize else nn.Identity()
        self.projects = nn.ModuleList(nn.Conv2d(token_dim, channels, 1) for channels in out_channels)
        self.resize_layers = nn.ModuleList(
            (
                nn.ConvTranspose2d(first, first, 4, 4),
                nn.ConvTranspose2d(second, second, 2, 2),
                nn.Identity(),
                nn.Conv2d(fourth, fourth, 3, 2, padding=1),
            )
        )
        self.scratch = nn.Module()
        for level, channels in enumerate((first, second, third, fourth), 1):
            self.scratch.add_module(f"layer{level}_rn", nn.Conv2d(channels, features, 3, padding=1, bias=False))
            self.scratch.add_module(f"refinenet{level}", _Fusion(features, rectified_skip, has_finer=level < 4))
        self.scratch.output_conv1 = nn.Conv2d(features, features // 2, 3, padding=1)
        self.scratch.output_conv2 = _output_layers(features // 2, out)
        self.outputs = ("output_conv2", "sky_output_conv2") if sky else ("output_conv2",)
        if sky:
            self.scratch.sky_output_conv2 = _output_layers(features // 2, 1)

    def fuse(self, tokens: Sequence[Tensor], grid: tuple[int, int]) -> Tensor:
        """Fuses four ``[N, P, D]`` token maps into ``[N, features / 2, H, W]``, before the output layers."""
        image_size = (grid[0] * self.patch_size, grid[1] * self.patch_size)
        maps = []
        for level, (tap, project, resize) in enumerate(zip(tokens, self.projects, self.resize_layers, strict=True), 1):
            x = project(self.norm(tap).transpose(1, 2).unflatten(-1, grid))  # [N, C, h, w]
            x = resize(self._add_position(x, image_size))
            maps.append(self.scratch.get_submodule(f"layer{level}_rn")(x))
        fused, finer = maps[3], None
        for level in (4, 3, 2, 1):
            finest = level == 1
            size = (2 * maps[0].shape[-2], 2 * maps[0].shape[-1]) if finest else maps[level - 2].shape[-2:]
            fused = self.scratch.get_submodule(f"refinenet{level}")(fused, finer, size)
            finer = None if finest else maps[level - 2]
        fused = upsample(self.scratch.get_submodule("output_conv1")(fused), image_size)
        return self._add_position(fused, image_size)

    def forward(self, tokens: Sequence[Tensor], grid: tuple[int, int]) -> Tensor:
        """Maps four ``[N, P, D]`` token maps to ``[N, out, H, W]``, plus one channel with ``sky``; no activation."""
        fused = self.fuse(tokens, grid)
        return torch.cat([self.scratch.get_submodule(name)(fused) for name in self.outputs], 1)

    def _add_position(self, x: Tensor, image_size: tuple[int, int]) -> Tensor:
        if self.position_weight == 0:
            return x
        size = (x.shape[-2], x.shape[-1])
        return x + uv_embedding(x.shape[1], size, image_size, self.position_weight, like=x)


def in_chunks(head: nn.Module, tokens: Sequence[Tensor], grid: tuple[int, int], chunk: int | None) -> Tensor:
    """Runs a head over ``[B, V, P, D]`` token maps, at most ``chunk`` views at a time.

    With more than one chunk, activations are checkpointed: the backward pass recomputes each chunk, so that only one
    chunk's activations are in memory at a time.

    Returns:
        ``[B, V, out, H, W]``.
    """
    flat = [tap.flatten(0, 1) for tap in tokens]
    count = flat[0].shape[0]
    if chunk is None or chunk >= count:
        out = head(flat, grid)
    else:
        chunks = zip(*(tap.split(chunk) for tap in flat), strict=True)
        out = torch.cat([checkpoint(head, part, grid, use_reentrant=False) for part in chunks])
    return out.unflatten(0, tokens[0].shape[:2])


def decode_geometry(head: nn.Module, tokens: Tokens, cameras: Cameras, chunk: int | None) -> Geometry:
    """Decodes z-depth (> 0) and confidence (> 1) with a head of two channels, in float32.

    Args:
        head: the DPT.
        tokens: tokens of all views.
        cameras: their decoded cameras.
        chunk: see :func:`in_chunks`.
    """
    with full_precision(tokens.camera):
        out = in_chunks(head, tokens.patch, tokens.grid, chunk)  # [B, V, 2, H, W]
    return Geometry(out[:, :, 0].exp(), 1 + out[:, :, 1].exp(), cameras, torch.ones_like(out[:, 0, 0, 0, 0]))
