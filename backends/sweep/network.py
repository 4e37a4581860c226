"""Plane-sweep multi-view stereo network: images and cameras to tokens, tokens to depth."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from backends.sweep.correlate import SourceWarp
from backends.sweep.features import CONTEXT_COARSE, FeaturePyramid, Features, unit_groups
from backends.sweep.refine import DepthHead, RefineNet, convex_upsample, slices
from backends.sweep.tokens import PATCH, TokenNet, patch_places
from backends.sweep.views import agreed_range, choose_sources, view_ranges, wide_range
from backends.sweep.volume import (
    PlaneSweep,
    VolumeNet,
    agreement,
    chunks_of_views,
    expectation,
    near_and_far,
    to_inverse,
)
from vg2gt.geometry.cameras import resize_intrinsics
from vg2gt.geometry.precision import full_precision

_BINS = 16  # channels that hold the summed probability of the planes
_FINE_PLANES = 12
_FINE_REACH = 1.5  # reach of the second sweep on either side, in plane spacings of the first
_FARTHEST = 4.0  # maximum swept depth, in multiples of the farthest plane
_WIDE_PLANES = 64  # planes of the sweeps that find the range
_BEYOND = (0.5, 3.0)  # factors on near and far of a hint: the range to search
_RANGE_CELLS = 2000  # maximum cells per feature map in these sweeps
_NEARER = 0.6  # near of the second of these sweeps, relative to the near that the first found


class PosedViews(NamedTuple):
    """V views of one scene, or of several scenes with the same number of views each (training).

    Attributes:
        images: ``[V, 3, H, W]`` in [0, 1], H and W multiples of 8.
        world_to_camera: ``[V, 4, 4]``.
        intrinsics: ``[V, 3, 3]`` in pixels, integer pixel centres.
        scenes: number of scenes; views of one scene are consecutive.
    """

    images: Tensor
    world_to_camera: Tensor
    intrinsics: Tensor
    scenes: int = 1

    @property
    def size(self) -> tuple[int, int]:
        """Image ``(height, width)``."""
        return (self.images.shape[-2], self.images.shape[-1])

    def warp(self, maps: Tensor, sources: Tensor, stride: int) -> SourceWarp:
        """Returns the correspondences of feature maps at ``1 / stride`` of the images with sources ``[V, n]``."""
        with full_precision(maps):  # half is off by pixels
            intrinsics = resize_intrinsics(self.intrinsics, 1 / stride, 1 / stride)
            return SourceWarp(self.world_to_camera, intrinsics, sources, (maps.shape[-2], maps.shape[-1]))


class Sweep(NamedTuple):
    """Result of one sweep.

    Attributes:
        logits: logits of the planes ``[V, D, h, w]``.
        position: positions of the planes, ``[V, D, h, w]`` or broadcastable; 0 is far, 1 is near.
        t: expected position ``[V, 1, h, w]``.
        mass: probability mass around it ``[V, 1, h, w]``.
    """

    logits: Tensor
    position: Tensor
    t: Tensor
    mass: Tensor


class SweepEncoding(NamedTuple):
    """Intermediate results between images and depth; ``h, w`` is 1/4 of the image size.

    Attributes:
        taps: patch tokens ``[V, P, DIM]`` of the last blocks.
        context: ``[V, C, h, w]``.
        context_fine: ``[V, C, 2 h, 2 w]``.
        swept: log-depth of the second sweep and its probability, ``[V, 2, 2 h, 2 w]``.
        first: first sweep.
        refined: position after the U-Net ``[V, 1, h, w]``.
        center: the same upsampled to ``[V, 1, 2 h, 2 w]``; the second sweep searches around it.
        second: second sweep.
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
        self.refine = RefineNet(CONTEXT_COARSE + 1 + 1 + 3 + _BINS, 1 + 36)  # outputs position and upsampling mask
        self.sweep_fine = PlaneSweep()
        self.volume_fine = VolumeNet()
        per_cell = CONTEXT_COARSE + 2 + 3  # context, refined position and first sweep's mass, agreement
        self.tokens = TokenNet(4 * per_cell + 16 * 2 + _BINS)
        self.head = DepthHead()

    def coarse(
        self, maps: Tensor, views: PosedViews, depth_range: Tensor, sources: Tensor, planes: int, stride: int = 4
    ) -> tuple[Sweep, Tensor]:
        """Sweeps feature maps over a depth range.

        Args:
            maps: matching features ``[V, C, h, w]``.
            views: the views.
            depth_range: near and far, ``[2]`` or ``[V, 2]``.
            sources: indices of the sources ``[V, n]``.
            planes: number of planes.
            stride: image size over map size.

        Returns:
            The sweep, and the :func:`agreement` of its depths ``[V, 3, h, w]``.
        """
        warp = views.warp(maps, sources, stride)
        position = torch.linspace(0, 1, planes, device=depth_range.device).view(1, -1, 1, 1)
        inverse = to_inverse(position, depth_range)[..., 0].expand(len(views.images), -1, -1)  # [V, D, 1]
        logits = _match(self.sweep, self.volume, maps, inverse, warp)
        t, mass = expectation(logits, position)
        agreeing = agreement(to_inverse(t.detach(), depth_range), warp)
        return Sweep(logits, position, t, mass), agreeing

    def find_range(self, features: Features, views: PosedViews, sources: int, hint: Tensor | None = None) -> Tensor:
        """Finds the range of depths of every view, from those on which views agree in wide sweeps at low resolution.

        A hint is searched beyond its limits, as sparse points lie on texture and miss near surfaces that few views see.
        Without a hint, a first sweep finds near, and a second sweep starts there so that its planes resolve far.

        Args:
            features: features of ``views.images``.
            views: views of one scene.
            sources: number of views that each view is matched with.
            hint: known near and far ``[2]``; None searches a range derived from the cameras.

        Returns:
            Near and far ``[V, 2]``, including the hint if there is one; see :func:`view_ranges`. If hardly any depth
            agrees, they are those of the hint or the searched range.
        """
        maps, stride = features.coarse, 4
        while maps.shape[-2] * maps.shape[-1] > _RANGE_CELLS:
            maps, stride = unit_groups(F.avg_pool2d(maps, 2)), 2 * stride

        def search(wide: Tensor, fallback: Tensor, least: float = 0.0) -> Tensor:
            """Agreed range of one sweep; ignores positions below ``least`` (0 is far, 1 is near)."""
            chosen = choose_sources(views.world_to_camera, views.intrinsics, views.size, wide, sources)
            sweep, agreeing = self.coarse(maps, views, wide, chosen, _WIDE_PLANES, stride)
            counts = (sweep.mass > 0.4) & (sweep.t >= least)
            return agreed_range(1 / to_inverse(sweep.t, wide), agreeing[:, 1:2] * counts, fallback)

        beyond = 1 / (_WIDE_PLANES - 1)  # sky and windows agree at any large depth, between the last two planes
        if hint is not None:
            found = search(hint * hint.new_tensor(_BEYOND), hint, least=beyond)
            found = torch.stack((torch.minimum(found[0], hint[0]), torch.maximum(found[1], hint[1])))
        else:
            wide = wide_range(views.world_to_camera)
            first = search(wide, wide)
            found = search(torch.stack((_NEARER * first[0], wide[1])), first, least=beyond)
        return view_ranges(views.world_to_camera, views.intrinsics, views.size, found)

    def encode(
        self, features: Features, views: PosedViews, depth_range: Tensor, sources: Tensor, planes: int
    ) -> SweepEncoding:
        """Encodes images as tokens.

        Args:
            features: features of ``views.images``.
            views: views of one or more scenes.
            depth_range: near and far of the planes ``[2]``, or ``[V, 2]`` if scenes differ.
            sources: indices of the sources of each view ``[V, n]``.
            planes: number of planes of the first sweep.
        """
        # first sweep at 1/4, refined by the U-Net: [V, 1, h, w]
        first, agreeing = self.coarse(features.coarse, views, depth_range, sources, planes)
        bins = slices(first.logits.softmax(1), _BINS)
        known = torch.cat((features.context, 4 * first.t, first.mass, agreeing, bins), 1)
        found = self.refine(known)
        refined = first.t + 0.25 * found[:, :1]
        # second sweep at 1/2: [V, ., 2 h, 2 w]
        center = convex_upsample(refined, found[:, 1:])  # bilinear would place it between the two sides of an edge
        second = self._narrow(features.fine, center.detach(), views, depth_range, sources, planes)
        inverse = to_inverse(second.t, depth_range).clamp_min(1 / (_FARTHEST * near_and_far(depth_range)[1]))
        swept = torch.cat((-inverse.log(), second.mass), 1)
        # patch features and tokens: [V, P, .]
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
        """Second sweep, at 1/2 of the image, around the positions ``center [V, 1, 2 h, 2 w]``."""
        warp = views.warp(fine, sources, 2)
        reach = _FINE_REACH / (planes - 1)
        offsets = torch.linspace(-reach, reach, _FINE_PLANES, device=fine.device).view(1, -1, 1, 1)
        position = center + offsets  # [V, D, 2 h, 2 w]
        least = 1 / (_FARTHEST * near_and_far(depth_range)[1])
        inverse = to_inverse(position, depth_range).clamp_min(least).flatten(2)
        logits = _match(self.sweep_fine, self.volume_fine, fine, inverse, warp)
        t, mass = expectation(logits, position)
        return Sweep(logits, position, t, mass)


def _match(sweep: PlaneSweep, volume: VolumeNet, features: Tensor, inverse: Tensor, warp: SourceWarp) -> Tensor:
    """Logits of the planes ``[V, D, h, w]``; without gradients, in chunks of a few views to save memory."""
    views, planes = inverse.shape[:2]
    parts = chunks_of_views(views)
    return torch.cat([volume(sweep(features, inverse[part], warp.select(part)), planes) for part in parts])
