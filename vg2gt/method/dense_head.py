"""Trainable dense prediction transformer (DPT): patch tokens and images to per-pixel features."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from vg2gt.types import Tokens


class _ResidualConvUnit(nn.Module):
    """``x + conv(relu(conv(relu(x))))`` with 3x3 kernels."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Maps ``[N, C, H, W]`` to the same shape."""
        return x + self.conv2(F.relu(self.conv1(F.relu(x))))


class _Reassemble(nn.Module):
    """Converts the tokens of one tapped layer to a feature map at a multiple of the patch grid's resolution.

    Args:
        token_dim: token width.
        channels: width of the feature map.
        factor: resolution relative to the patch grid: 4, 2, 1 or 0.5.
    """

    def __init__(self, token_dim: int, channels: int, factor: float) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(token_dim)
        self.project = nn.Linear(token_dim, channels)
        if factor > 1:
            size = int(factor)
            self.resize: nn.Module = nn.ConvTranspose2d(channels, channels, size, stride=size)
        elif factor == 1:
            self.resize = nn.Identity()
        else:
            self.resize = nn.Conv2d(channels, channels, 3, stride=2, padding=1)
        self.smooth = nn.Conv2d(channels, channels, 3, padding=1, bias=False)

    def forward(self, tokens: Tensor, grid: tuple[int, int]) -> Tensor:
        """Maps ``[N, P, D]`` tokens on a ``(rows, columns)`` grid to ``[N, C, factor * rows, factor * columns]``."""
        # the permuted view is already channels-last, the fast memory format of convolutions
        features = self.project(self.norm(tokens)).unflatten(1, grid).permute(0, 3, 1, 2)
        return self.smooth(self.resize(features))


class DenseHead(nn.Module):
    """DPT over the tapped layers, merged with image features (paper, Fine-level Gaussian Scene Decoding).

    The token pyramid is fused from coarse to fine, as in the depth head. Its finest level is upsampled bilinearly to
    full resolution and added to a shallow convolution of the image, the only source of detail below the patch size.

    Args:
        token_dims: width of each tapped layer, shallow to deep.
        patch_size: pixels per patch side.
        features: width of the pyramid.
        out_channels: width of the result.
        merge_channels: width at full resolution before the last convolution; None uses ``out_channels``.
        finest: resolution of the shallowest tap relative to the patch grid: 4, 2 or 1. Each next tap has half of it,
            down to 0.5.
        views_per_chunk: views decoded at a time; bounds the peak memory at inference.
    """

    def __init__(
        self,
        token_dims: Sequence[int],
        patch_size: int,
        features: int = 256,
        out_channels: int = 128,
        merge_channels: int | None = None,
        finest: int = 4,
        views_per_chunk: int = 8,
    ) -> None:
        super().__init__()
        if finest not in (1, 2, 4):
            raise ValueError(f"dense_head.finest must be 1, 2 or 4, got {finest}")
        factors = [max(finest / 2**i, 0.5) for i in range(len(token_dims))]
        self.patch_size = patch_size
        self.out_channels = out_channels
        self.views_per_chunk = views_per_chunk
        self.reassemble = nn.ModuleList(
            _Reassemble(dim, features, factor) for dim, factor in zip(token_dims, factors, strict=True)
        )
        self.refine_skip = nn.ModuleList(_ResidualConvUnit(features) for _ in token_dims[1:])
        self.refine = nn.ModuleList(_ResidualConvUnit(features) for _ in token_dims)
        merge_channels = merge_channels or out_channels
        self.reduce = nn.Conv2d(features, merge_channels, 3, padding=1)
        self.image = nn.Conv2d(3, merge_channels, 3, padding=1)
        self.merge = nn.Conv2d(merge_channels, out_channels, 3, padding=1)

    def forward(self, tokens: Tokens, images: Tensor) -> Tensor:
        """Decodes features.

        Args:
            tokens: ``[B, V, P, D]`` per tap.
            images: ``[B, V, 3, H, W]`` in [0, 1].

        Returns:
            ``[B * V, out_channels, H, W]``, channels-last in memory.
        """
        chunks = list(self.chunks(tokens, images))
        return chunks[0] if len(chunks) == 1 else torch.cat(chunks)

    def chunks(self, tokens: Tokens, images: Tensor) -> Iterator[Tensor]:
        """Decodes features ``views_per_chunk`` views at a time; concatenated, they equal :meth:`forward`."""
        taps = [tap.flatten(0, 1) for tap in tokens.patch]
        pictures = images.flatten(0, 1)
        for begin in range(0, len(pictures), self.views_per_chunk):
            rows = slice(begin, begin + self.views_per_chunk)
            yield self._decode([tap[rows] for tap in taps], tokens.grid, pictures[rows])

    def _decode(self, taps: list[Tensor], grid: tuple[int, int], images: Tensor) -> Tensor:
        maps = [layer(tap, grid) for layer, tap in zip(self.reassemble, taps, strict=True)]
        fused = self.refine[-1](maps[-1])
        for i in range(len(maps) - 2, -1, -1):
            fused = F.interpolate(fused, size=maps[i].shape[-2:], mode="bilinear", align_corners=False)
            fused = self.refine[i](fused + self.refine_skip[i](maps[i]))
        coarse = F.interpolate(self.reduce(fused), size=images.shape[-2:], mode="bilinear", align_corners=False)
        detail = self.image((2 * images - 1).contiguous(memory_format=torch.channels_last))
        return self.merge(F.gelu(coarse + detail))
