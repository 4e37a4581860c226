"""Evidence for and against the depth of every pixel and the position of every Gaussian."""

from __future__ import annotations

from enum import IntEnum

import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.geometry.cameras import camera_centers, focal_lengths, project
from vg2gt.types import Cameras, Geometry
from vg2gt.visibility.check import choose_partners, depth_differences
from vg2gt.visibility.counts import count_views

TOLERANCE, MARGIN = 0.02, 0.04  # relative depth differences at which views agree, or look through
CLOSE = 0.005  # relative depth difference at which views agree closely
_POINT_TOLERANCE, _POINT_MARGIN = 0.03, 0.05  # the same for points, which lie on a voxel's mean surface
_PARTNERS = 24  # maximum number of views that each view is compared with
EVIDENCE = ("confidence", "views", "closely", "against", "step", "parallax", "differences")


class Status(IntEnum):
    """Support of a pixel or a Gaussian; larger is better.

    Attributes:
        UNSEEN: no view sees it, or a mask excludes it.
        GUESSED: views look there but have no depth: background, the far shell, holes that refinement fills.
        CONTRADICTED: more views look through it than agree with it.
        SINGLE: only one view measures it.
        AGREED: two or more views do, within 2 % of their depth (Gaussians: 3 %).
    """

    UNSEEN = 0
    GUESSED = 1
    CONTRADICTED = 2
    SINGLE = 3
    AGREED = 4


@torch.no_grad()
def pixel_evidence(geometry: Geometry, keep: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Returns evidence and status of the decoded depth of one scene.

    Args:
        geometry: geometry of one scene (B = 1).
        keep: ``[1, V, H, W]`` bool, pixels that the scene is made of (:mod:`vg2gt.visibility.check`);
            others count as contradicted. None: all that have a depth.

    Returns:
        :data:`EVIDENCE` as ``[V, H, W, F]`` float32, finite, 0 without depth, and :class:`Status`, ``[V, H, W]`` uint8.
        The evidence is, in order: the logarithm of the backbone's confidence; log2 of one plus the number of views
        that agree; the share of these that agree closely; the share of views that look through; the logarithm of the
        largest relative depth step to a neighbour; the logarithm of depth over focal length times baseline, which is
        the relative depth change per pixel of parallax; the logarithm of the upper quartile of the relative depth
        differences between the views of the whole scene.
    """
    depth = geometry.depth[0].float().nan_to_num(0.0, 0.0, 0.0).clamp(min=0)
    cameras, known = geometry.cameras, depth > 0
    partners = choose_partners(depth, cameras, _PARTNERS)
    near = count_views(depth, cameras, partners, CLOSE, MARGIN).agree
    counts = count_views(depth, cameras, partners, TOLERANCE, MARGIN)
    seen = counts.agree + counts.through + counts.hidden
    parallax = focal_lengths(cameras.intrinsics)[0].mean(-1).float() * _baselines(cameras, partners)
    evidence = torch.stack(
        (
            geometry.depth_conf[0].float().clamp(min=1e-6).log(),
            (1 + counts.agree).log2(),
            near / counts.agree.clamp(min=1),
            counts.through / seen.clamp(min=1),
            _steps(depth).clamp(min=1e-6).log(),
            (depth / parallax.clamp(min=1e-12)[:, None, None]).clamp(1e-6, 1e6).log(),
            _upper_quartile(depth_differences(depth, cameras, partners)).clamp(min=1e-6).log().expand_as(depth),
        ),
        -1,
    )
    against = counts.through > counts.agree
    if keep is not None:
        against |= ~keep[0]
    status = torch.full_like(depth, Status.SINGLE)
    status[counts.agree > 0] = Status.AGREED
    status[against] = Status.CONTRADICTED
    status[~known] = Status.GUESSED
    return torch.where(known[..., None], evidence, 0.0), status.to(torch.uint8)


@torch.no_grad()
def point_support(
    points: Tensor, depth: Tensor, cameras: Cameras, error: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Returns status and error bound of points in space, such as the centres of Gaussians.

    Args:
        points: ``[N, 3]`` in the world frame of the cameras.
        depth: ``[V, H, W]`` z-depth that the scene is made of, 0 = none.
        cameras: cameras of the views (B = 1).
        error: ``[V, H, W]`` bound e of the depth's error: it is off by a factor of at most 1 + e; None: it is exact.

    Returns:
        :class:`Status` as ``[N]`` uint8, and such a bound ``[N]`` for a point's depth: the pixel's factor times the one
        between point and pixel, minimised over the views that agree; infinite where no view agrees.
    """
    count, height, width = len(points), *depth.shape[1:]
    agree, through, blank = (torch.zeros(count, device=points.device) for _ in range(3))
    bound = torch.full((count,), torch.inf, device=points.device)
    for view in range(len(depth)):
        pixels, z = project(points[None, None], cameras.select(slice(view, view + 1)))
        column, row = pixels[0, 0].nan_to_num(-1.0, -1.0, -1.0).round().unbind(-1)
        inside = (z[0, 0] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        index = torch.where(inside, row * width + column, 0).long()
        found = depth[view].flatten()[index]
        ratio = z[0, 0] / found.clamp(min=1e-12)
        known = inside & (found > 0)
        agrees = known & ((ratio - 1).abs() < _POINT_TOLERANCE)
        agree += agrees
        through += known & (ratio < 1 - _POINT_MARGIN)
        blank += inside & (found <= 0)
        own = torch.maximum(ratio, 1 / ratio.clamp(min=1e-12)) - 1  # of the point to the pixel
        own = own if error is None else own + (1 + own) * error[view].flatten()[index]
        bound = torch.where(agrees, torch.minimum(bound, own), bound)
    status = torch.full_like(bound, Status.UNSEEN)
    status[blank > 0] = Status.GUESSED
    status[agree == 1] = Status.SINGLE
    status[agree > 1] = Status.AGREED
    status[through > agree] = Status.CONTRADICTED
    return status.to(torch.uint8), bound


def _baselines(cameras: Cameras, partners: Tensor) -> Tensor:
    """Returns the mean distance ``[V]`` of each view to its partners, or to all views if it has none."""
    centers = camera_centers(cameras)[0].float()
    distance = torch.cdist(centers, centers)
    chosen = torch.zeros_like(distance).scatter_add_(1, partners.clamp(min=0), (partners >= 0).to(distance))
    chosen = torch.where(chosen.sum(1, keepdim=True) > 0, chosen, 1.0)
    return (chosen * distance).sum(1) / chosen.sum(1)


def _upper_quartile(differences: Tensor) -> Tensor:
    """Returns the upper quartile of ``[N]`` relative differences; 1 if there are none."""
    count = len(differences)
    return differences.kthvalue(-(-3 * count // 4)).values if count else differences.new_ones(())


def _steps(depth: Tensor) -> Tensor:
    """Returns the largest relative depth difference ``[V, H, W]`` to the eight neighbours."""
    far = F.max_pool2d(depth[:, None], 3, 1, 1)[:, 0]
    near = -F.max_pool2d(-depth[:, None], 3, 1, 1)[:, 0]
    return torch.maximum(far - depth, depth - near) / depth.clamp(min=1e-12)
