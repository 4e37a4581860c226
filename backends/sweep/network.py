"""Plane-sweep multi-view stereo network: images and cameras to tokens, tokens to depth."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from backends.sweep.correlate import SourceWarp
from backends.sweep.features import CONTEXT_COARSE, FeaturePyramid, Features
from backends.sweep.planes import FARTHEST, PLANES, Planes
from backends.sweep.refine import (
    CELLS,
    UPSAMPLING,
    DepthHead,
    PlainBlock,
    RefineNet,
    activate,
    convex_upsample,
    slices,
)
from backends.sweep.stage import Matching, Stage
from backends.sweep.tokens import DIM, PATCH, POSITION_CHANNELS, TAPS, TokenBlock, attend, patch_places
from backends.sweep.views import baselines
from backends.sweep.volume import agreement
from vg2gt.geometry.cameras import resize_intrinsics

_SPACING = 1 / (PLANES - 1)
_QUARTER, _HALF = (16, 0.25 * _SPACING), (8, 0.1 * _SPACING)  # planes of a row, and spacing, of the later stages
ROWS = (1, 3, 1)  # rows of planes of the stages
_OTHER = 3 * _SPACING  # distance from a centre from which on a plane of the first stage counts as another answer
# The nearest depth of so many cells at 1/4 is tried as well, with this on its logits (chosen: 2 of 0 to 3). It was not
# part of training. Thin things in front are found: outdoor scenes lose 13 % of their error, rooms 3 %.
_AROUND, _NEARER = 9, 2.0
_NEVER = -30.0  # on the logits of a row that repeats the first
_CHANNELS = (16, 16, 8)  # of the regularisation of each stage
_AGREEMENT = (0.1, 0.05)  # widths of the agreement at 1/8 and 1/4
_FARTHEST_MATCHED, _BEYOND = 0.95, 1.5  # quantile of the matched depth of a scene, and the greatest depth over it
_BINS = 16  # channels that hold the summed probability of the planes
_STATED = 1 + 1 + 3 + _BINS  # relative log-depth, mass, agreement, bins
_CHANGES, _SHOWN = 3, 32  # channels of the U-Net: corrections, and what the tokens see


class PosedViews(NamedTuple):
    """V views of one scene.

    Attributes:
        images: ``[V, 3, H, W]`` in [0, 1], H and W multiples of 8.
        world_to_camera: ``[V, 4, 4]``.
        intrinsics: ``[V, 3, 3]`` in pixels, integer pixel centres.
    """

    images: Tensor
    world_to_camera: Tensor
    intrinsics: Tensor

    @property
    def size(self) -> tuple[int, int]:
        """Image ``(height, width)``."""
        return (self.images.shape[-2], self.images.shape[-1])

    def warp(self, maps: Tensor, sources: Tensor, stride: int) -> SourceWarp:
        """Returns the correspondences of feature maps at ``1 / stride`` of the images with sources ``[V, n]``."""
        intrinsics = resize_intrinsics(self.intrinsics, 1 / stride, 1 / stride)
        return SourceWarp(self.world_to_camera, intrinsics, sources, (maps.shape[-2], maps.shape[-1]))


class SweepEncoding(NamedTuple):
    """Intermediate results between images and depth; ``h, w`` is 1/4 of the image size.

    Attributes:
        taps: patch tokens ``[V, P, DIM]`` of the last blocks.
        context: ``[V, C, h, w]``.
        context_fine: ``[V, C, 2 h, 2 w]``.
        swept: log-depth of the last stage, its probability, that at 1/4 and the share of the matched depth in what the
            stages are centred on, ``[V, 4, 2 h, 2 w]``.
        origin: first channels of the last tap, for which decoding adds no direct correction, ``[V, P, 4]``.
        stages: the three stages, at 1/8, 1/4 and 1/2 of the image.
        guess: log-depth of the monocular branch at 1/8.
        centers: log-depth on which each stage but the first is centred, at 1/8 (matched or guessed), 1/4 and 1/2.
    """

    taps: tuple[Tensor, ...]
    context: Tensor
    context_fine: Tensor
    swept: Tensor
    origin: Tensor
    stages: tuple[Stage, ...]
    guess: Tensor
    centers: tuple[Tensor, ...]


class _Swept(NamedTuple):
    """The stage at 1/8, and what follows from it.

    Attributes:
        stage: the stage.
        matched: its log-depth ``[V, 1, h, w]``.
        agreeing: its :func:`agreement` with the sources ``[V, 3, h, w]``.
        scale: median log-depth of what matches.
        farthest: greatest log-depth of the scene.
    """

    stage: Stage
    matched: Tensor
    agreeing: Tensor
    scale: Tensor
    farthest: Tensor


class SweepNet(nn.Module):
    """Matches at 1/8 over all depths, fills in what does not match, and matches twice more around that."""

    def __init__(self) -> None:
        super().__init__()
        self.features = FeaturePyramid()
        self.matching = nn.ModuleList(Matching(channels, level == 0) for level, channels in enumerate(_CHANNELS))
        self.refine = RefineNet(CONTEXT_COARSE + _STATED, _CHANGES + UPSAMPLING + _SHOWN)
        self.embed = nn.Sequential(
            nn.Linear(4 * CONTEXT_COARSE + _STATED + _CHANGES + _SHOWN, 2 * DIM), nn.GELU(), nn.Linear(2 * DIM, DIM)
        )
        self.position = nn.Linear(POSITION_CHANNELS, DIM)
        self.blocks = nn.ModuleList(TokenBlock(DIM, 4, i % 2 == 1, 2 + 2 * (i % 2)) for i in range(4))
        self.fill = nn.Linear(DIM, 2)
        self.begin = nn.Conv2d(CONTEXT_COARSE + 6, 48, 3, 1, 1)
        self.block = PlainBlock(48)
        self.end = nn.Conv2d(48, 1 + UPSAMPLING, 3, 1, 1)
        self.embed_fine = nn.Sequential(nn.Linear(4 * 6 + 16 * 2, 2 * DIM), nn.GELU(), nn.Linear(2 * DIM, DIM))
        self.head = DepthHead()
        self.other = nn.Linear(3, 1)  # logit of the other answer at 1/4, from the probabilities of both and the share
        self.gate = nn.Parameter(torch.tensor([-3.0, 4.0, 8.0]))  # bias, mass, mass times greatest agreement
        for layer in (self.fill, self.end, self.embed_fine[2]):
            nn.init.zeros_(layer.weight)  # pyright: ignore[reportArgumentType]
            nn.init.zeros_(layer.bias)  # pyright: ignore[reportArgumentType]
        nn.init.zeros_(self.other.weight)
        nn.init.constant_(self.other.bias, -1.0)

    def encode(
        self, features: Features, views: PosedViews, sources: Tensor, shown: Tensor | None = None
    ) -> SweepEncoding:
        """Encodes images as tokens.

        Args:
            features: features of ``views.images``.
            views: the views.
            sources: indices of the sources of each view ``[V, n]``.
            shown: 0 where a view is matched with no source (training), else 1, ``[V, 1, H / 8, W / 8]``.
        """
        planes = Planes(baselines(views.world_to_camera))
        # all depths at 1/8; what does not match is filled in
        swept, visible = self._eighth(features, views, sources, planes, shown)
        tokens, change, mask = self._fill(swept, features, views)
        center, guess, share = self._blend(swept, change)
        # twice more, around that
        quarter = convex_upsample(center, mask)
        warp = views.warp(features.match[1], sources, 4)
        second, visible = self._quarter(quarter, swept.stage, share, features, planes, warp, visible.detach())
        log_depth = -planes.inverse(second.t).log()
        agreeing = agreement((-log_depth).exp().detach(), warp, _AGREEMENT[1])
        known = torch.cat((log_depth - swept.scale, second.mass, agreeing, log_depth - quarter), 1)
        found = self.begin(torch.cat((features.context, known), 1))
        found = self.end(activate(self.block(found)))
        half = convex_upsample(log_depth + 0.1 * found[:, :1], found[:, 1:])
        third, _ = self._narrow(2, half, _HALF, features, planes, views.warp(features.match[2], sources, 2), visible)
        log_depth = -planes.inverse(third.t).log()
        taps = self._taps(tokens, known, log_depth, third.mass, swept.scale, views)
        sure = F.interpolate(torch.cat((F.avg_pool2d(second.mass, 2), share), 1), size=log_depth.shape[-2:])
        return SweepEncoding(
            taps[-TAPS:],
            features.context,
            features.context_fine,
            torch.cat((log_depth, third.mass, sure), 1),
            taps[-1][..., : CELLS**2],
            (swept.stage, second, third),
            guess,
            (center, quarter, half),
        )

    def _eighth(
        self, features: Features, views: PosedViews, sources: Tensor, planes: Planes, shown: Tensor | None
    ) -> tuple[_Swept, Tensor]:
        """The stage at 1/8 on all planes; arguments as in :meth:`encode`.

        Returns:
            What it found, and the visibility of the pixels in the sources ``[V, n, h, w]``.
        """
        warp = views.warp(features.match[0], sources, 8)
        position = torch.linspace(0, 1, PLANES, device=sources.device).view(1, -1, 1, 1)
        position = position.expand(len(sources), -1, -1, -1)
        first, visible = self.matching[0](features.match[0], position, planes, warp, None, shown)
        matched = -planes.inverse(first.t).log()
        agreeing = agreement((-matched).exp().detach(), warp, _AGREEMENT[0])
        if shown is not None:
            agreeing = agreeing * shown
        reliable = first.mass.detach() * agreeing[:, 1:2]
        scale = _weighted_quantile(matched.detach(), reliable, 0.5)
        farthest = _weighted_quantile(matched.detach(), reliable, _FARTHEST_MATCHED) + math.log(_BEYOND)
        return _Swept(first, matched, agreeing, scale, farthest), visible

    def _fill(self, swept: _Swept, features: Features, views: PosedViews) -> tuple[Tensor, Tensor, Tensor]:
        """Guesses what does not match: a U-Net, then attention within and across views.

        Returns:
            Tokens ``[V, P, DIM]``, changes of the matched depth, of the guess and of the share ``[V, 3, h, w]``, and
            the mask that upsamples to 1/4 ``[V, UPSAMPLING, h, w]``.
        """
        first, grid = swept.stage, (views.size[0] // PATCH, views.size[1] // PATCH)
        bins = slices(first.logits.softmax(1), _BINS)
        stated = torch.cat((swept.matched - swept.scale, first.mass, swept.agreeing, bins), 1)
        found = self.refine(torch.cat((F.avg_pool2d(features.context, 2), stated), 1))
        change, mask, seen = found.split((_CHANGES, UPSAMPLING, _SHOWN), 1)
        patches = torch.cat((F.pixel_unshuffle(features.context, 2), stated, change, seen), 1)
        tokens = self.embed(patches.flatten(2).mT)
        place = self._places(self._blend(swept, change)[0], swept.scale, views)
        tokens = attend(self.blocks[:2], tokens, place, grid)[-1]
        filled = F.pad(self.fill(tokens).mT.unflatten(-1, grid), (0, 0, 0, 0, 1, 0))
        return tokens, change + filled, mask

    def _blend(self, swept: _Swept, change: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns log-depth, matched or guessed, the guess, and the share of the matched one, ``[V, 1, h, w]``."""
        mass, agreeing = swept.stage.mass, swept.agreeing[:, 1:2]
        sure = torch.stack((torch.ones_like(mass), mass, mass * agreeing), -1) @ self.gate
        guess = swept.scale + change[:, 1:2]
        share = torch.sigmoid(sure + change[:, 2:])
        center = share * (swept.matched + 0.1 * change[:, :1]) + (1 - share) * guess
        # walls without texture were taken for sky in rooms unlike those of training
        return center if self.training else torch.minimum(center, swept.farthest), guess, share

    def _taps(
        self, tokens: Tensor, known: Tensor, log_depth: Tensor, mass: Tensor, scale: Tensor, views: PosedViews
    ) -> tuple[Tensor, ...]:
        """Adds what the later stages found to the tokens; returns those of the last blocks."""
        fine = F.pixel_unshuffle(torch.cat((log_depth - scale, mass), 1), 4)
        tokens = tokens + self.embed_fine(torch.cat((F.pixel_unshuffle(known, 2), fine), 1).flatten(2).mT)
        place = self._places(F.avg_pool2d(log_depth, 4), scale, views)
        return attend(self.blocks[2:], tokens, place, (views.size[0] // PATCH, views.size[1] // PATCH))

    def _quarter(
        self,
        center: Tensor,
        first: Stage,
        share: Tensor,
        features: Features,
        planes: Planes,
        warp: SourceWarp,
        visible: Tensor,
    ) -> tuple[Stage, Tensor]:
        """The stage at 1/4, on three rows of planes.

        They lie around ``center``, around the likeliest plane not near it, and around the nearest depth of the
        surroundings. At 1/8 a thin object shares its cell with what is behind it, and a wrong guess may replace a right
        match.

        Args:
            center: log-depth ``[V, 1, h, w]``.
            first: the stage at 1/8.
            share: share of the matched depth in ``center``, ``[V, 1, h / 2, w / 2]``.
            features: features of all views.
            planes: unit of their planes.
            warp: correspondences with the sources.
            visible: visibility of the pixels in them ``[V, n, h / 2, w / 2]``.

        Returns:
            The stage, with the planes of all rows, and the visibility ``[V, n, h, w]``.
        """
        likely = F.interpolate(first.logits.detach().softmax(1), size=center.shape[-2:], mode="nearest")
        share = F.interpolate(share.detach(), size=center.shape[-2:], mode="nearest")
        position = planes.position(center.detach())
        near = (first.position - position).abs() <= _OTHER  # [V, PLANES, h, w]
        held = (likely * near).sum(1, keepdim=True)

        def bias(probability: Tensor) -> Tensor:
            return self.other(torch.cat((probability, held, share), 1).movedim(1, -1)).movedim(-1, 1)  # [V, 1, h, w]

        best, index = likely.masked_fill(near, 0).max(1, keepdim=True)
        nearest = F.max_pool2d(position, _AROUND, 1, _AROUND // 2)
        is_nearer = nearest - position > _OTHER
        nearest = torch.where(is_nearer, nearest, position)
        plane = (nearest / _SPACING).round().long().clamp(1, PLANES - 2)
        found = torch.stack([likely.gather(1, plane + offset) for offset in (-1, 0, 1)]).sum(0)
        of_nearest = torch.where(is_nearer, bias(found) + _NEARER, _NEVER)
        biases = torch.cat((torch.zeros_like(best), bias(best), of_nearest), 1)
        rows = [
            self._narrow(1, row, _QUARTER, features, planes, warp, visible)
            for row in (center, -planes.inverse(index * _SPACING).log(), -planes.inverse(nearest).log())
        ]
        logits = torch.stack([stage.logits for stage, _ in rows], 1) + biases[:, :, None]  # [V, 3, D, h, w]
        # the depth is that of the row with the likeliest peak, so that rows are never averaged
        chosen = logits.amax(2).argmax(1, keepdim=True)  # [V, 1, h, w]
        shares = logits.logsumexp(2).softmax(1)
        mass = torch.cat([stage.mass for stage, _ in rows], 1) * shares
        t = torch.cat([stage.t for stage, _ in rows], 1)
        places = torch.cat([stage.position for stage, _ in rows], 1)
        return Stage(logits.flatten(1, 2), places, t.gather(1, chosen), mass.gather(1, chosen)), rows[0][1]

    def _narrow(
        self,
        level: int,
        center: Tensor,
        spaced: tuple[int, float],
        features: Features,
        planes: Planes,
        warp: SourceWarp,
        visible: Tensor,
    ) -> tuple[Stage, Tensor]:
        """A stage on planes around the log-depth ``center``; ``visible`` is at half its resolution."""
        count, spacing = spaced
        offsets = torch.arange(count, device=center.device).view(1, -1, 1, 1) - (count - 1) / 2
        position = (planes.position(center.detach()) + spacing * offsets).clamp_min(FARTHEST)
        visible = F.interpolate(visible, size=center.shape[-2:], mode="nearest")
        return self.matching[level](features.match[level], position, planes, warp, visible)

    def _places(self, log_depth: Tensor, scale: Tensor, views: PosedViews) -> Tensor:
        """Embedded positions of the patches, at the given log-depth, in units of the scene's matched depth."""
        depth, grid = log_depth.detach().flatten(1).exp(), (log_depth.shape[-2], log_depth.shape[-1])
        return self.position(patch_places(depth, views.world_to_camera, views.intrinsics, scale.exp(), grid))


def _weighted_quantile(values: Tensor, weight: Tensor, share: float) -> Tensor:
    """Weighted quantile of all values, a scalar."""
    values, order = values.flatten().sort()
    mass = (weight.flatten() + 1e-4)[order].cumsum(0)
    return values[(mass < share * mass[-1]).sum()]
