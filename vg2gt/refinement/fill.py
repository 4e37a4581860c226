"""Fills holes of a scene, where the images show something and no Gaussian does."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.geometry.cameras import unproject
from vg2gt.geometry.spherical_harmonics import rgb_to_sh
from vg2gt.method.additions.surfel import ALONE
from vg2gt.refinement.loss import Observations
from vg2gt.rendering import Renderer
from vg2gt.types import Cameras, Gaussians

COVERED = 0.5  # minimum accumulated opacity of a covered pixel
OPACITY = 0.9  # of a new Gaussian: high enough to cover its block, low enough to be pruned if it is wrong


@torch.no_grad()
def fill_holes(
    gaussians: Gaussians,
    cameras: Cameras,
    seen: Observations,
    renderer: Renderer,
    views: Tensor,
    side: int,
    room: int,
) -> Gaussians:
    """Adds round Gaussians along uncovered rays, at depths spread from around each hole.

    A backbone has no depth for glass, beyond a sensor's range, or for the sky, so a feed-forward scene shows its
    background there. View by view, each block of mostly uncovered pixels gets one Gaussian, and is covered for the
    next view. The depth is a guess that refinement has to correct.

    Args:
        gaussians: the scene (B = 1).
        cameras: cameras of its V views (B = 1).
        seen: observations of the views.
        renderer: renderer that decides what is covered.
        views: ``[N]`` views to fill.
        side: side of a block in pixels.
        room: maximum number of Gaussians to add; if there would be more, blocks are larger.

    Returns:
        The scene with the new Gaussians after its own.
    """
    found = renderer(gaussians, cameras.select(views))
    holes = int((found.alpha < COVERED).sum())
    if not holes or room < 1:
        return gaussians
    pixels = max(side, math.ceil(math.sqrt(holes / room)))
    for view in views.split(1):
        camera, shown = cameras.select(view), seen.views(view)
        rendered = renderer(gaussians, camera)
        hole = (rendered.alpha[0] < COVERED)[:, None].to(shown.images.dtype)  # [1, 1, H, W]
        depth = torch.where(shown.depth > 0, shown.depth, torch.where(hole[:, 0] > 0, 0.0, rendered.depth[0]))
        if not (depth > 0).any():
            continue
        gaussians = gaussians.joined(_blocks(shown.images, hole, spread(depth), camera, pixels))
    return gaussians


def spread(depth: Tensor) -> Tensor:
    """Fills zeros of depth ``[V, H, W]`` from around them, with means of the logarithm over ever larger blocks."""
    known = (depth > 0).to(depth.dtype)[:, None]
    return _pushed(torch.where(known > 0, depth[:, None].clamp(min=1e-12).log(), 0.0), known)[:, 0].exp()


def _pushed(values: Tensor, known: Tensor) -> Tensor:
    """Returns ``values [V, 1, H, W]``, interpolated smoothly from nearby where they are not ``known``."""
    if known.bool().all() or max(values.shape[-2:]) == 1:
        return values
    share = F.avg_pool2d(known, 2, ceil_mode=True)
    mean = F.avg_pool2d(values * known, 2, ceil_mode=True) / share.clamp(min=1e-6)
    coarse = _pushed(mean, (share > 0).to(values.dtype))
    return torch.where(known > 0, values, F.interpolate(coarse, values.shape[-2:], mode="bilinear"))


def _blocks(images: Tensor, hole: Tensor, depth: Tensor, camera: Cameras, pixels: int) -> Gaussians:
    """Returns a Gaussian for each block of one view that is mostly ``hole [1, 1, H, W]``."""

    def mean(values: Tensor) -> Tensor:  # over the hole's pixels in each block: [N, C]
        pooled = F.avg_pool2d(values * hole, pixels, ceil_mode=True) / share.clamp(min=1e-6)
        return pooled[0].flatten(1).T[chosen]

    share = F.avg_pool2d(hole, pixels, ceil_mode=True)
    chosen = (share > 0.5).flatten()
    means = mean(unproject(depth[None], camera)[0].movedim(-1, 1))
    focal = camera.intrinsics[0, 0, [0, 1], [0, 1]].mean()
    size = ALONE * pixels * mean(depth[:, None]) / focal  # [N, 1]
    turn = F.pad(torch.ones_like(size), (0, 3))
    return Gaussians(
        means,
        turn,
        size.expand(-1, 3),
        torch.full_like(size[:, 0], OPACITY),
        rgb_to_sh(mean(images))[:, None],
        torch.zeros_like(size[:, 0], dtype=torch.int64),
    )
