"""Cost volumes: weighted means of similarities, their regularisation, the depth read from them and its agreement."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from backends.sweep.correlate import BEHIND, GROUPS, SourceWarp
from backends.sweep.features import upsample

_VIEWS_AT_A_TIME = 4
_WINDOW = 2  # planes on either side of the most likely one to average over


def chunks_of_views(views: int) -> list[slice]:
    """Splits a number of views into slices to be matched one after the other: all views at once with gradients."""
    step = views if torch.is_grad_enabled() else _VIEWS_AT_A_TIME
    return [slice(first, min(first + step, views)) for first in range(0, views, step)]


def mean_similarity(similarity: Tensor, weight: Tensor, size: tuple[int, int]) -> Tensor:
    """Averages similarities over the sources.

    Args:
        similarity: ``[V, n, D, h w, GROUPS]``.
        weight: weights of the sources ``[V, n, D, h w]``.
        size: ``(h, w)``.

    Returns:
        Weighted mean similarity per group, and the mean weight of the sources: ``[V D, GROUPS + 1, h, w]``.
    """
    weights = weight.sum(1)[..., None]  # [V, D, h w, 1]
    mean = (weight[..., None] * similarity).sum(1) / (weights + 1e-3)
    volume = torch.cat((mean, weights / weight.shape[1]), -1)  # [V, D, h w, GROUPS + 1]
    return volume.reshape(-1, *size, GROUPS + 1).permute(0, 3, 1, 2)


class _PlaneBlock(nn.Module):
    """Residual block on a volume: 3x3 in the image, then 5 along the planes, as 2D convolutions (3D ones are slow)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.image = nn.Conv2d(channels, channels, 3, 1, 1)
        self.planes = nn.Conv2d(channels, channels, (5, 1), 1, (2, 0))

    def forward(self, x: Tensor, planes: int) -> Tensor:
        """Maps plane images ``[V D, C, h, w]``, channels-last, to the same shape."""
        y = F.relu(self.image(x), inplace=True).permute(0, 2, 3, 1)  # [V D, h, w, C]
        images = y.shape
        y = y.reshape(-1, planes, images[1] * images[2], images[3]).permute(0, 3, 1, 2)  # [V, C, D, h w]
        change = self.planes(y).permute(0, 2, 3, 1).reshape(images).permute(0, 3, 1, 2)  # [V D, C, h, w]
        return x + change  # not in place: on a view, the gradients would lose channels-last


class VolumeNet(nn.Module):
    """Light 2.5D regularisation of a volume to one logit per plane, at full and half resolution."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.begin = nn.Conv2d(GROUPS + 1, channels, 3, 1, 1)
        self.first = _PlaneBlock(channels)
        self.down = nn.Conv2d(channels, 2 * channels, 2, 2)
        self.coarse = nn.ModuleList(_PlaneBlock(2 * channels) for _ in range(2))
        self.up = nn.Conv2d(2 * channels, channels, 1)
        self.last = _PlaneBlock(channels)
        self.end = nn.Conv2d(channels, 1, 1)
        self.sharpness = nn.Parameter(torch.tensor(6.0))  # adds the similarity to the logits, also before training

    def forward(self, volume: Tensor, planes: int) -> Tensor:
        """Maps ``[V D, GROUPS + 1, h, w]`` to logits ``[V, D, h, w]``."""
        x = F.relu(self.first(F.relu(self.begin(volume), inplace=True), planes), inplace=True)
        if min(x.shape[-2:]) > 1:  # images of 8 pixels have no half resolution
            y = F.relu(self.down(x), inplace=True)
            for block in self.coarse:
                y = F.relu(block(y, planes), inplace=True)
            x = F.relu(upsample(self.up(y), x).add_(x), inplace=True)
        similarity = volume.permute(0, 2, 3, 1)[..., :GROUPS].mean(-1)  # [V D, h, w]
        logits = 4 * self.end(self.last(x, planes)) + self.sharpness * similarity[:, None]
        return logits.view(-1, planes, *volume.shape[-2:])


def expectation(logits: Tensor, positions: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the expected plane position around the most likely plane, and the probability mass there.

    Args:
        logits: ``[V, D, h, w]``.
        positions: positions of the planes ``[V, D, h, w]``, or with size 1 for V, h and w.

    Returns:
        Position and mass, each ``[V, 1, h, w]``.
    """
    probability = logits.softmax(1)
    best = probability.argmax(1, keepdim=True)
    window = torch.arange(-_WINDOW, _WINDOW + 1, device=logits.device).view(1, -1, 1, 1)
    around = (best + window).clamp(0, logits.shape[1] - 1)
    weights = probability.gather(1, around)
    mass = weights.sum(1, keepdim=True)
    mean = (weights * positions.expand_as(logits).gather(1, around)).sum(1, keepdim=True) / (mass + 1e-6)
    return mean, mass


def agreement(inverse: Tensor, warp: SourceWarp, width: float) -> Tensor:
    """Compares each view's depth with the depth of its sources.

    Args:
        inverse: inverse depth of all views ``[V, 1, h, w]``.
        warp: correspondences of all views.
        width: relative difference at which agreement falls to 1/e.

    Returns:
        ``[V, 3, h, w]``: mean and maximum agreement over the sources, in [0, 1], and 3 times their mean relative
        difference (clamped to 0.3), which is positive where a source sees a nearer surface.
    """
    views, _, height, width = inverse.shape
    agreements, differences = [], []
    for source in range(warp.sources.shape[1]):
        grid, inside, z = warp(source, inverse.flatten(2))
        there = F.grid_sample(inverse[warp.sources[:, source]], grid, padding_mode="border", align_corners=False)
        difference = there[:, :, 0] * (z / inverse.flatten(2)).clamp_min(BEHIND) - 1
        agreements.append(torch.exp(-difference.abs() / width) * inside)
        differences.append(difference.clamp(-0.3, 0.3) * inside)
    every = torch.stack(agreements)  # [n, V, 1, h w]
    summary = (every.mean(0), every.amax(0), 3 * torch.stack(differences).mean(0))
    return torch.cat(summary, 1).view(views, 3, height, width)
