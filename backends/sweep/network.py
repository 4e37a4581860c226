"""The plane-sweep multi-view stereo network: images and cameras to tokens, tokens to depth."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from backends.sweep.correlate import SourceWarp
from backends.sweep.features import CONTEXT_COARSE, FeaturePyramid, Features, unit_groups
from backends.sweep.head import DepthHead
from backends.sweep.refine import RefineNet, convex_upsample, slices
from backends.sweep.tokens import PATCH, TokenNet, patch_places
from backends.sweep.views import agreed_range, choose_sources, wide_range
from backends.sweep.volume import (
    PlaneSweep,
    VolumeNet,
    agreement,
    expectation,
    near_and_far,
    to_inverse,
)
from vg2gt.geometry.cameras import resize_intrinsics
from vg2gt.geometry.precision import full_precision

_BINS = 16  # channels that the planes' probability is summed into
_FINE_PLANES = 12
_FINE_REACH = 1.5  # of the second sweep on either side, in spacings of the first
_VIEWS_AT_A_TIME = 4
_FARTHEST = 4.0  # decoded depth at most, in multiples of the farthest plane
_LOG_DEPTH = 20.0  # of decoded depth at most either way: finite whatever the tokens are
WIDE_PLANES = 64  # of the sweeps that find the range
_BEYOND = (0.5, 3.0)  # times near and far of a hint: the range that is searched
_RANGE_CELLS = 2000  # of a view's map, at most, in these sweeps
_NEARER = 0.6  # times near of the first of them: where the second begins


class PosedViews(NamedTuple):
    """V views of one scene, or of several with equally many views each (training).

    Attributes:
        images: ``[V, 3, H, W]`` in [0, 1], H and W multiples of 8.
        world_to_camera: ``[V, 4, 4]``.
        intrinsics: ``[V, 3, 3]`` in pixels, integer pixel centres.
        scenes: number of scenes; views of one scene follow one another.
    """

    images: Tensor
    world_to_camera: Tensor
    intrinsics: Tensor
    scenes: int = 1

    @property
    def size(self) -> tuple[int, int]:
        """Image ``(height, width)``."""
        return (self.images.shape[-2], self.images.shape[-1])


class Sweep(NamedTuple):
    """What one sweep found.

    Attributes:
        logits: ``[V, D, h, w]``.
        position: ``[V, D, h, w]`` or broadcastable: places of the planes, 0 at far and 1 at near.
        t: ``[V, 1, h, w]`` expected position.
        mass: ``[V, 1, h, w]`` probability around it.
    """

    logits: Tensor
    position: Tensor
    t: Tensor
    mass: Tensor


class SweepEncoding(NamedTuple):
    """Everything between images and depth.

    Attributes:
        taps: patch tokens ``[V, P, DIM]`` of the last blocks.
        context: ``[V, C, h, w]``, a quarter of the image.
        context_fine: ``[V, C, 2 h, 2 w]``.
        swept: ``[V, 2, 2 h, 2 w]`` log-depth of the second sweep and its probability.
        first: the first sweep.
        refined: ``[V, 1, h, w]`` position after the U-Net.
        center: ``[V, 1, 2 h, 2 w]`` the same at the second sweep's resolution: it searches around it.
        second: the second sweep.
    """

    taps: tuple[Tensor, ...]
    context: Tensor
    context_fine: Tensor
    swept: Tensor
    first: Sweep
    refined: Tensor
    center: Tensor
    second: Sweep


class SweepNet(nn.Module):
    """Learned plane sweep: a wide sweep at 1/4, a U-Net, a narrow sweep at 1/2, tokens of 8x8 patches, a depth head."""

    def __init__(self) -> None:
        super().__init__()
        self.features = FeaturePyramid()
        self.sweep = PlaneSweep()
        self.volume = VolumeNet()
        self.refine = RefineNet(CONTEXT_COARSE + 1 + 1 + 3 + _BINS, 1 + 36)  # position, and how it is upsampled
        self.sweep_fine = PlaneSweep()
        self.volume_fine = VolumeNet()
        per_cell = CONTEXT_COARSE + 2 + 3  # context, refined position and first probability, agreement
        self.tokens = TokenNet(4 * per_cell + 16 * 2 + _BINS)
        self.head = DepthHead()

    def coarse(
        self, maps: Tensor, views: PosedViews, depth_range: Tensor, sources: Tensor, planes: int, stride: int = 4
    ) -> tuple[Sweep, Tensor]:
        """A sweep of ``maps [V, C, h, w]`` over ``[near, far]`` and the agreement of its depths ``[V, 3, h, w]``."""
        warp = _warp(maps, views, sources, stride)
        position = torch.linspace(0, 1, planes, device=depth_range.device).view(1, -1, 1, 1)
        inverse = to_inverse(position, depth_range)[..., 0].expand(len(views.images), -1, -1)  # [V, D, 1]
        logits = _match(self.sweep, self.volume, maps, inverse, warp)
        t, mass = expectation(logits, position)
        agreeing = agreement(to_inverse(t.detach(), depth_range), warp)
        return Sweep(logits, position, t, mass), agreeing

    def find_range(self, features: Features, views: PosedViews, sources: int, hint: Tensor | None = None) -> Tensor:
        """Searches the range of depths on which views agree, in sweeps that are wide and coarse.

        Sparse points lie where there is texture and miss what is near in few views, so a hint is searched beyond.
        From the cameras alone, a first sweep finds near; a second one begins there, so that its planes resolve far.

        Args:
            features: of ``views.images``.
            views: of one scene.
            sources: views that each is compared with.
            hint: ``[2]`` near and far of what is known to be seen; None: the cameras alone say where to search.

        Returns:
            ``[2]`` near and far, around the hint if there is one; where hardly any depth agrees, the hint or the whole
            range that was searched.
        """
        maps, stride = features.coarse, 4
        while maps.shape[-2] * maps.shape[-1] > _RANGE_CELLS:
            maps, stride = unit_groups(F.avg_pool2d(maps, 2)), 2 * stride

        def search(wide: Tensor, fallback: Tensor, least: float = 0.0) -> Tensor:
            """The agreed range of one sweep; positions up to ``least`` (0 at far, 1 at near) do not count."""
            chosen = choose_sources(views.world_to_camera, views.intrinsics, views.size, wide, sources)
            sweep, agreeing = self.coarse(maps, views, wide, chosen, WIDE_PLANES, stride)
            counts = (sweep.mass > 0.4) & (sweep.t >= least)
            return agreed_range(1 / to_inverse(sweep.t, wide), agreeing[:, 1:2] * counts, fallback)

        if hint is not None:
            found = search(hint * hint.new_tensor(_BEYOND), hint)
            return torch.stack((torch.minimum(found[0], hint[0]), torch.maximum(found[1], hint[1])))
        wide = wide_range(views.world_to_camera)
        first = search(wide, wide)
        # The sky and windows agree at any large depth, between the last two planes.
        return search(torch.stack((_NEARER * first[0], wide[1])), first, least=1 / (WIDE_PLANES - 1))

    def encode(
        self, features: Features, views: PosedViews, depth_range: Tensor, sources: Tensor, planes: int
    ) -> SweepEncoding:
        """Images to tokens.

        Args:
            features: of ``views.images``.
            views: of one scene or several.
            depth_range: ``[2]`` near and far of the planes, or ``[V, 2]`` where scenes differ.
            sources: ``[V, n]`` indices of the views that each is compared with.
            planes: of the first sweep.
        """
        first, agreeing = self.coarse(features.coarse, views, depth_range, sources, planes)
        bins = slices(first.logits.softmax(1), _BINS)
        known = torch.cat((features.context, 4 * first.t, first.mass, agreeing, bins), 1)
        found = self.refine(known)
        refined = first.t + 0.25 * found[:, :1]
        center = convex_upsample(refined, found[:, 1:])  # a bilinear one would search between the two sides of an edge
        second = self._narrow(features.fine, center.detach(), views, depth_range, sources, planes)
        inverse = to_inverse(second.t, depth_range).clamp_min(1 / (_FARTHEST * near_and_far(depth_range)[1]))
        swept = torch.cat((-inverse.log(), second.mass), 1)
        grid = (views.size[0] // PATCH, views.size[1] // PATCH)
        cells = torch.cat((features.context, 4 * refined, first.mass, agreeing), 1)
        parts = (F.pixel_unshuffle(cells, 2), F.pixel_unshuffle(torch.cat((4 * second.t, second.mass), 1), 4))
        patches = torch.cat((*parts, F.avg_pool2d(bins, 2)), 1).flatten(2).mT  # [V, P, .]
        depth = F.avg_pool2d(-swept[:, :1], 4).exp().flatten(1).reciprocal()
        with full_precision(depth):
            cameras = (views.world_to_camera, views.intrinsics)
            place = patch_places(depth.detach(), *cameras, depth_range, grid, views.scenes)
        taps = self.tokens(patches, place, grid, views.scenes)
        return SweepEncoding(taps, features.context, features.context_fine, swept, first, refined, center, second)

    def _narrow(
        self, fine: Tensor, center: Tensor, views: PosedViews, depth_range: Tensor, sources: Tensor, planes: int
    ) -> Sweep:
        """The second sweep, at half of the image, around the positions ``center [V, 1, 2 h, 2 w]``."""
        warp = _warp(fine, views, sources, 2)
        reach = _FINE_REACH / (planes - 1)
        offsets = torch.linspace(-reach, reach, _FINE_PLANES, device=fine.device).view(1, -1, 1, 1)
        position = center + offsets  # [V, D, 2 h, 2 w]
        least = 1 / (_FARTHEST * near_and_far(depth_range)[1])
        inverse = to_inverse(position, depth_range).clamp_min(least).flatten(2)
        logits = _match(self.sweep_fine, self.volume_fine, fine, inverse, warp)
        t, mass = expectation(logits, position)
        return Sweep(logits, position, t, mass)

    def decode(
        self, taps: tuple[Tensor, ...], context: Tensor, context_fine: Tensor, swept: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Tokens to depth and log-scale of its relative error, each ``[V, H, W]``; see :class:`DepthHead`."""
        grid = (context.shape[-2] // 2, context.shape[-1] // 2)
        log_depth, log_scale = self.head(taps, grid, context, context_fine, swept)
        return log_depth.clamp(-_LOG_DEPTH, _LOG_DEPTH).exp(), log_scale


def _match(sweep: PlaneSweep, volume: VolumeNet, features: Tensor, inverse: Tensor, warp: SourceWarp) -> Tensor:
    """Logits of planes ``[V, D, h, w]``; without gradient a few views at a time, because volumes are large."""
    views, planes = inverse.shape[:2]
    step = views if torch.is_grad_enabled() else _VIEWS_AT_A_TIME
    parts = [slice(first, min(first + step, views)) for first in range(0, views, step)]
    return torch.cat([volume(sweep(features, inverse[part], warp.select(part)), planes) for part in parts])


def _warp(maps: Tensor, views: PosedViews, sources: Tensor, stride: int) -> SourceWarp:
    """Correspondences of feature maps at ``1 / stride`` of the images; half precision would move them by pixels."""
    with full_precision(maps):
        intrinsics = resize_intrinsics(views.intrinsics, 1 / stride, 1 / stride)
        return SourceWarp(views.world_to_camera, intrinsics, sources, (maps.shape[-2], maps.shape[-1]))
