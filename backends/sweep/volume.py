"""The sweep: features of other views warped onto planes, compared, regularised and read as depth."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from backends.sweep.correlate import BEHIND, GROUPS, SourceWarp, correlate

_WINDOW = 2  # planes on either side of the best one that are averaged
_AGREEMENT_WIDTH = 0.03  # relative difference of depths at which agreement falls to 1/e


def near_and_far(depth_range: Tensor) -> tuple[Tensor, Tensor]:
    """The two depths of ``[2]``, or of ``[V, 2]`` as ``[V, 1, 1, 1]``."""
    near, far = depth_range.unbind(-1)
    return (near, far) if near.dim() == 0 else (near.view(-1, 1, 1, 1), far.view(-1, 1, 1, 1))


def to_inverse(t: Tensor, depth_range: Tensor) -> Tensor:
    """Inverse depth of ``t [V, ., h, w]``: 0 at far, 1 at near, linear in between."""
    near, far = near_and_far(depth_range)
    return 1 / far + t * (1 / near - 1 / far)


def from_inverse(inverse: Tensor, depth_range: Tensor) -> Tensor:
    """``t`` of an inverse depth."""
    near, far = near_and_far(depth_range)
    return (inverse - 1 / far) / (1 / near - 1 / far)


class PlaneSweep(nn.Module):
    """Group-wise similarity of every view with its sources on planes, sources weighted by what they show."""

    def __init__(self) -> None:
        super().__init__()
        self.weigh = nn.Sequential(nn.Conv2d(GROUPS, 16, 1), nn.ReLU(inplace=True), nn.Conv2d(16, 1, 1))

    def forward(self, features: Tensor, inverse: Tensor, warp: SourceWarp) -> Tensor:
        """Compares views: mean similarity per group and the sources' weight, ``[V D, GROUPS + 1, h, w]``.

        Args:
            features: ``[N, C, h, w]`` of unit length per group, of all views.
            inverse: ``[V, D, h w]`` inverse depths of the planes, or ``[V, D, 1]``.
            warp: of all views or some.
        """
        size = (features.shape[-2], features.shape[-1])
        views, sources = warp.sources.shape
        planes = inverse.shape[1]
        similarity, inside = correlate(features, inverse.expand(-1, -1, size[0] * size[1]), warp)
        images = similarity.reshape(-1, *size, GROUPS).permute(0, 3, 1, 2)  # [V n D, G, h, w]
        weight = torch.sigmoid(self.weigh(images).float()).reshape(*inside.shape, 1) * inside[..., None]
        weights = weight.sum(1)  # [V, D, h w, 1]
        mean = (weight * similarity).sum(1) / (weights + 1e-3)
        volume = torch.cat((mean, weights / sources), -1)  # [V, D, h w, G + 1]
        return volume.reshape(views * planes, *size, GROUPS + 1).permute(0, 3, 1, 2)


def to_planes(volume: Tensor, size: tuple[int, int]) -> Tensor:
    """``[V, C, D, h w]`` as images of planes ``[V D, C, h, w]``, channels-last."""
    views, channels, planes, _ = volume.shape
    images = volume.permute(0, 2, 3, 1).reshape(views * planes, *size, channels)  # [V D, h, w, C]
    return images.permute(0, 3, 1, 2)


class PlaneBlock(nn.Module):
    """A residual of a volume: 3x3 in the image, then 5 along the planes, both as 2D convolutions (3D ones are slow)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.image = nn.Conv2d(channels, channels, 3, 1, 1)
        self.planes = nn.Conv2d(channels, channels, (5, 1), 1, (2, 0))

    def forward(self, x: Tensor, planes: int) -> Tensor:
        """Maps images of planes ``[V D, C, h, w]``, channels-last, to the same shape."""
        size = x.shape[-2:]
        y = F.relu(self.image(x), inplace=True).permute(0, 2, 3, 1)  # [V D, h, w, C]
        y = y.reshape(-1, planes, size[0] * size[1], y.shape[-1]).permute(0, 3, 1, 2)  # [V, C, D, h w]
        return x + to_planes(
            self.planes(y), (size[0], size[1])
        )  # in place on a view, gradients would lose channels-last


class VolumeNet(nn.Module):
    """Light 2.5D regularisation of a volume, with ``channels`` at full and half resolution: one logit per plane."""

    def __init__(self, channels: tuple[int, int] = (16, 32)) -> None:
        super().__init__()
        self.begin = nn.Conv2d(GROUPS + 1, channels[0], 3, 1, 1)
        self.first = PlaneBlock(channels[0])
        self.down = nn.Conv2d(channels[0], channels[1], 2, 2)
        self.coarse = nn.ModuleList(PlaneBlock(channels[1]) for _ in range(2))
        self.up = nn.Conv2d(channels[1], channels[0], 1)
        self.last = PlaneBlock(channels[0])
        self.end = nn.Conv2d(channels[0], 1, 1)
        self.sharpness = nn.Parameter(torch.tensor(6.0))  # similarity itself is a logit, from the first step on

    def forward(self, volume: Tensor, planes: int) -> Tensor:
        """Maps ``[V D, GROUPS + 1, h, w]`` to logits ``[V, D, h, w]`` in float32."""
        x = F.relu(self.first(F.relu(self.begin(volume), inplace=True), planes), inplace=True)
        y = F.relu(self.down(x), inplace=True)
        for block in self.coarse:
            y = F.relu(block(y, planes), inplace=True)
        up = F.interpolate(self.up(y), size=x.shape[-2:], mode="bilinear", align_corners=False)
        x = F.relu(up.add_(x), inplace=True)
        similarity = volume.permute(0, 2, 3, 1)[..., :GROUPS].mean(-1)  # [V D, h, w]
        logits = 4 * self.end(self.last(x, planes)).float() + self.sharpness * similarity[:, None]
        return logits.view(-1, planes, *volume.shape[-2:])


def expectation(logits: Tensor, positions: Tensor) -> tuple[Tensor, Tensor]:
    """Mean of the planes' positions about the most likely plane, and the probability there, each ``[V, 1, h, w]``.

    Logits are ``[V, D, h, w]``, positions also with 1 in place of V, h and w.
    """
    probability = logits.softmax(1)
    best = probability.argmax(1, keepdim=True)
    window = torch.arange(-_WINDOW, _WINDOW + 1, device=logits.device).view(1, -1, 1, 1)
    around = (best + window).clamp(0, logits.shape[1] - 1)
    weights = probability.gather(1, around)
    mass = weights.sum(1, keepdim=True)
    mean = (weights * positions.expand_as(logits).gather(1, around)).sum(1, keepdim=True) / (mass + 1e-6)
    return mean, mass


def agreement(inverse: Tensor, warp: SourceWarp) -> Tensor:
    """Mean and largest agreement in [0, 1] of the sources' own depths, and the signed difference: ``[V, 3, h, w]``.

    Of inverse depth ``[V, 1, h, w]``; the difference is positive where the source sees something nearer.
    """
    views, _, height, width = inverse.shape
    agreements, differences = [], []
    for source in range(warp.sources.shape[1]):
        grid, inside, z = warp(source, inverse.flatten(2))
        there = F.grid_sample(inverse[warp.sources[:, source]], grid, padding_mode="border", align_corners=False)[
            :, :, 0
        ]  # [V, 1, h w]
        difference = there * (z / inverse.flatten(2)).clamp_min(BEHIND) - 1
        agreements.append(torch.exp(-difference.abs() / _AGREEMENT_WIDTH) * inside)
        differences.append(difference.clamp(-0.3, 0.3) * inside)
    every = torch.stack(agreements)  # [n, V, 1, h w]
    summary = (every.mean(0), every.amax(0), 3 * torch.stack(differences).mean(0))
    return torch.cat(summary, 1).view(views, 3, height, width)
