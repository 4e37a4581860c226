"""Image features of the plane sweep: matching features (unit length per group) at 1/8 to 1/2, and context."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from backends.sweep.correlate import GROUPS

_MATCH = 32  # matching channels
CONTEXT_COARSE, CONTEXT_FINE = 48, 16


class Features(NamedTuple):
    """Features of N images; ``h, w`` is 1/8 of the image size.

    Attributes:
        match: matching features at 1/8, 1/4 and 1/2, each group of channels of unit length.
        context: ``[N, CONTEXT_COARSE, 2 h, 2 w]``.
        context_fine: ``[N, CONTEXT_FINE, 4 h, 4 w]``.
    """

    match: tuple[Tensor, Tensor, Tensor]
    context: Tensor
    context_fine: Tensor


class _InstanceNorm(nn.Module):
    """Instance normalisation from elementary operations; torch's is slow on channels-last CPU tensors."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, x: Tensor) -> Tensor:
        """Normalises ``[N, C, h, w]`` over h and w."""
        centered = x - x.mean((2, 3), keepdim=True)
        variance = centered.square().mean((2, 3), keepdim=True)
        scale = torch.rsqrt(variance + 1e-5) * self.weight[:, None, None]
        return centered * scale + self.bias[:, None, None]


def conv_norm(inputs: int, outputs: int, stride: int = 1, kernel: int = 3, relu: bool = True) -> nn.Sequential:
    """Returns convolution, instance normalisation and, with ``relu``, ReLU."""
    conv = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False)
    return nn.Sequential(conv, _InstanceNorm(outputs), *([nn.ReLU(inplace=True)] if relu else []))


def upsample(x: Tensor, like: Tensor) -> Tensor:
    """Resizes ``[N, C, h, w]`` bilinearly to the size of another tensor."""
    return F.interpolate(x, size=like.shape[-2:], mode="bilinear", align_corners=False)


class _ResidualBlock(nn.Module):
    """Residual block of two 3x3 convolutions."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = conv_norm(channels, channels)
        self.second = conv_norm(channels, channels, relu=False)

    def forward(self, x: Tensor) -> Tensor:
        """Maps ``[N, C, h, w]`` to the same shape."""
        return F.relu(x + self.second(self.first(x)))


class FeaturePyramid(nn.Module):
    """Small feature pyramid network from 1/2 to 1/16 of the image."""

    def __init__(self) -> None:
        super().__init__()
        self.to_half = nn.Sequential(conv_norm(3, 32, 2, 5), conv_norm(32, 32))
        self.to_quarter = nn.Sequential(conv_norm(32, 48, 2), _ResidualBlock(48), _ResidualBlock(48))
        self.to_eighth = nn.Sequential(conv_norm(48, 64, 2), _ResidualBlock(64), _ResidualBlock(64))
        self.to_sixteenth = nn.Sequential(conv_norm(64, 96, 2), _ResidualBlock(96))
        self.from_sixteenth = nn.Conv2d(96, 64, 1)
        self.from_eighth = nn.Conv2d(64, 48, 1)
        self.from_quarter = nn.Conv2d(48, 32, 1)
        self.merge = conv_norm(48, 48)
        self.merge_half = conv_norm(32, 32)
        self.eighth = nn.Conv2d(64, _MATCH, 3, 1, 1)
        self.coarse = nn.Conv2d(48, _MATCH, 3, 1, 1)
        self.fine = nn.Conv2d(32, _MATCH, 3, 1, 1)
        # no ReLU: it can die in the first steps, and the context with it
        self.context = conv_norm(48, CONTEXT_COARSE, relu=False)
        self.context_fine = conv_norm(32, CONTEXT_FINE, relu=False)

    def forward(self, images: Tensor) -> Features:
        """Extracts features of images ``[N, 3, H, W]`` in [0, 1]; H and W multiples of 8."""
        half = self.to_half((images - 0.5) * 3)
        quarter = self.to_quarter(half)
        eighth = self.to_eighth(quarter)
        eighth = F.relu(eighth + upsample(self.from_sixteenth(self.to_sixteenth(eighth)), eighth))
        quarter = self.merge(quarter + upsample(self.from_eighth(eighth), quarter))
        half = self.merge_half(half + upsample(self.from_quarter(quarter), half))
        coarse = unit_groups(self.coarse(quarter))
        pooled = unit_groups(F.avg_pool2d(coarse, 2) + self.eighth(eighth))
        match = (pooled, coarse, unit_groups(self.fine(half)))
        return Features(match, self.context(quarter), self.context_fine(half))


def unit_groups(x: Tensor) -> Tensor:
    """Normalises every group of channels (equal c % GROUPS) of ``[N, C, h, w]`` to unit length."""
    grouped = x.permute(0, 2, 3, 1).unflatten(-1, (-1, GROUPS))  # [N, h, w, C / GROUPS, GROUPS]
    length = grouped.square().sum(-2, keepdim=True).clamp_min(1e-6).sqrt()
    return (grouped / length).flatten(-2).permute(0, 3, 1, 2)
