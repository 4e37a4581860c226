"""Small U-Net that refines the first sweep: fills in depth where matching fails (bare walls, occlusions)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F


def activate(x: Tensor) -> Tensor:
    """Leaky ReLU; residual sums without normalisation drift, and a plain ReLU would die below zero."""
    return F.leaky_relu(x, 0.1)


class PlainBlock(nn.Module):
    """Residual block of two 3x3 convolutions, without normalisation, as absolute values matter here."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, 1, 1)
        self.second = nn.Conv2d(channels, channels, 3, 1, 1)
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        """Maps ``[N, C, h, w]`` to the same shape."""
        return x + self.second(activate(self.first(activate(x))))


class RefineNet(nn.Module):
    """U-Net at 1/4, 1/8 and 1/16 of the image with the given ``channels``; its outputs are zero before training."""

    def __init__(self, inputs: int, outputs: int, channels: tuple[int, int, int] = (64, 96, 128)) -> None:
        super().__init__()
        fine, middle, coarse = channels
        self.begin = nn.Sequential(nn.Conv2d(inputs, fine, 3, 1, 1), PlainBlock(fine))
        self.down = nn.Sequential(nn.Conv2d(fine, middle, 3, 2, 1), PlainBlock(middle))
        self.bottom = nn.Sequential(nn.Conv2d(middle, coarse, 3, 2, 1), PlainBlock(coarse), PlainBlock(coarse))
        self.up = nn.Conv2d(coarse, middle, 1)
        self.merge = PlainBlock(middle)
        self.up_fine = nn.Conv2d(middle, fine, 1)
        self.merge_fine = PlainBlock(fine)
        self.end = nn.Conv2d(fine, outputs, 3, 1, 1)
        nn.init.zeros_(self.end.weight)
        nn.init.zeros_(self.end.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        """Maps ``[N, inputs, h, w]`` to ``[N, outputs, h, w]`` in float32."""
        fine = self.begin(x)
        middle = self.down(activate(fine))
        middle = self.merge(middle + _upsample(self.up(self.bottom(activate(middle))), middle))
        fine = self.merge_fine(fine + _upsample(self.up_fine(middle), fine))
        return self.end(activate(fine)).float()


def _upsample(x: Tensor, like: Tensor) -> Tensor:
    return F.interpolate(x, size=like.shape[-2:], mode="bilinear", align_corners=False)


def convex_upsample(x: Tensor, mask: Tensor) -> Tensor:
    """Upsamples by two, each new pixel a convex combination of 3x3 neighbours (RAFT).

    Args:
        x: ``[V, C, h, w]``.
        mask: logits of the weights ``[V, 36, h, w]``, 9 neighbours times 4 new pixels.

    Returns:
        ``[V, C, 2 h, 2 w]``.
    """
    views, channels, height, width = x.shape
    weights = mask.unflatten(1, (9, 4)).softmax(1)  # [V, 9, 4, h, w]
    around = F.unfold(F.pad(x, (1, 1, 1, 1), mode="replicate"), 3).view(views, channels, 9, 1, height, width)
    return F.pixel_shuffle((around * weights[:, None]).sum(2).flatten(1, 2), 2)


def slices(probability: Tensor, bins: int) -> Tensor:
    """Sums the probability of the planes ``[V, D, h, w]`` into ``bins`` channels, for any D."""
    flat = probability.flatten(2).transpose(1, 2)  # [V, h w, D]
    pooled = F.adaptive_avg_pool1d(flat, bins) * (probability.shape[1] / bins)
    return torch.unflatten(pooled.transpose(1, 2), 2, probability.shape[-2:])
