"""Density control: fewer Gaussians where views do not support them, and some in holes, where there are none."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn import functional as F

from vg2gt.geometry.cameras import unproject
from vg2gt.geometry.rotations import matrix_to_quat, quat_to_matrix
from vg2gt.geometry.spherical_harmonics import rgb_to_sh
from vg2gt.method.additions.far_shell import is_far
from vg2gt.method.additions.surfel import ALONE
from vg2gt.method.grid import plan_voxels, point_cells, pool_mean
from vg2gt.refinement.options import Observations
from vg2gt.rendering import Renderer
from vg2gt.types import Cameras, Gaussians
from vg2gt.visibility import count_points

TOLERANCE, MARGIN = 0.03, 0.05  # relative depth differences at which a view agrees with a Gaussian, or looks through it
FEWEST = 2  # minimum number of views that agree with Gaussians to merge
GROWTH = 2.0  # factor on merged standard deviations: neighbours overlap, and refinement has to add the detail
OPACITY = 0.5  # of merged Gaussians
COVERED = 0.5  # minimum accumulated opacity of a covered pixel
_NEIGHBOURS = 3  # of a point of structure from motion, whose mean distance is its size
_POINT = 0.5  # its opacity
_FILLED = 0.9  # opacity of a Gaussian in a hole: high enough to cover its block, low enough to be pruned if it is wrong


def supported(
    gaussians: Gaussians,
    cameras: Cameras,
    depth: Tensor,
    views: int,
    merge_cells: float = 0.0,
    renderer: Renderer | None = None,
) -> Gaussians:
    """Returns the Gaussians that enough views agree with and no more look through; all if there are none.

    Depth without texture is unreliable, and with many views some of its errors agree by chance. Refined as they are,
    such small Gaussians fit their source views and become floaters in all others; merged, they become smooth.

    What a single view agrees with is merged, too, where this view would otherwise show nothing or the background:
    otherwise the ground near the first and the last camera of a walk is lost.

    Args:
        gaussians: the scene (B = 1).
        cameras: cameras of its V views (B = 1).
        depth: ``[V, H, W]`` depth of the views, 0 = unknown.
        views: minimum number of views that agree, capped at half of V.
        merge_cells: merge Gaussians that fewer, but at least two views agree with, in cells this many times as wide as
            what the median Gaussian covers; 0: remove them.
        renderer: renderer that decides where a view would show nothing; None: do not ask.
    """
    agree, through = count_points(gaussians.means, depth, cameras, TOLERANCE, MARGIN)
    far = is_far(gaussians, depth, cameras)  # the far shell behind everything stays
    keep = (agree >= min(views, len(depth) // 2)) & (through <= agree) | far
    weak = (agree >= min(FEWEST, len(depth) // 2)) & (through <= agree) & ~keep
    if not keep.any():
        return gaussians
    kept = gaussians.select(keep)
    if merge_cells and renderer is not None:
        alone = uncovered(gaussians.select(keep | weak), cameras, depth, renderer)
        agree_there, _ = count_points(gaussians.means, alone, cameras, TOLERANCE, MARGIN)
        weak |= (agree_there > 0) & (through <= agree) & ~keep
    if not merge_cells or not weak.any():
        return kept
    sizes = gaussians.scales[~far].max(-1).values
    return kept.joined(merged(gaussians.select(weak), merge_cells * float(sizes.median()) / ALONE))


@torch.no_grad()
def uncovered(gaussians: Gaussians, cameras: Cameras, depth: Tensor, renderer: Renderer) -> Tensor:
    """Returns the depth ``[V, H, W]`` of the pixels at which a scene shows nothing, or what is far behind; 0 elsewhere.

    Args:
        gaussians: the scene (B = 1).
        cameras: cameras of its V views (B = 1).
        depth: ``[V, H, W]`` depth of the views, 0 = unknown.
        renderer: renderer of the scene.
    """
    with_depth, left = replace(renderer, geometry=True), torch.zeros_like(depth)
    for view, own in enumerate(depth):
        shown = with_depth(gaussians, cameras.select(slice(view, view + 1)))
        behind = shown.depth[0, 0] > (1 + 2 * MARGIN) * own
        left[view] = torch.where(behind | (shown.alpha[0, 0] < COVERED), own, 0.0)
    return left


def merged(gaussians: Gaussians, cell: float) -> Gaussians:
    """Merges the Gaussians of each cell into one: mean and covariance of their mixture, weighted by opacity, widened.

    The moments are those of Kerbl et al., A Hierarchical 3D Gaussian Representation (2024).

    Args:
        gaussians: one scene (B = 1).
        cell: edge of the cells in scene units.
    """
    cells = point_cells(gaussians.means, gaussians.batch, gaussians.means.new_tensor([cell]))
    plan = plan_voxels(cells, gaussians.batch)

    weights = gaussians.opacities.clamp(min=1e-6)  # a cell may hold only transparent Gaussians

    def mean(values: Tensor) -> Tensor:
        return pool_mean(values.flatten(1), weights, plan).unflatten(1, values.shape[1:])

    means = mean(gaussians.means)
    axes = quat_to_matrix(gaussians.quats) * gaussians.scales[:, None]
    away = (gaussians.means - means[plan.voxel_of])[:, :, None]
    variances, turn = torch.linalg.eigh(mean((axes @ axes.mT + away @ away.mT) / cell**2).double())
    turn = turn * torch.linalg.det(turn).sign()[:, None, None]  # eigenvectors may be a reflection
    smallest = gaussians.scales.min() / cell  # rounding can make a flat Gaussian's variance negative
    scales = GROWTH * cell * variances.clamp(min=float(smallest) ** 2).sqrt()
    return Gaussians(
        means,
        matrix_to_quat(turn).to(means.dtype),
        scales.to(means.dtype),
        torch.full_like(means[:, 0], OPACITY),
        mean(gaussians.sh),
        plan.batch,
        gaussians.background,
    )


@torch.no_grad()
def with_points(gaussians: Gaussians, points: Tensor, colors: Tensor) -> Gaussians:
    """Adds round Gaussians at points of structure from motion that no Gaussian is near.

    A Gaussian is as large as the mean distance to the three nearest points, as in 3DGS. A point that has a Gaussian
    within this distance gets none.

    Args:
        gaussians: the scene (B = 1).
        points: ``[N, 3]`` positions.
        colors: ``[N, 3]`` in [0, 1].
    """
    if len(points) <= _NEIGHBOURS:
        return gaussians
    positions = points.cpu().numpy()
    gaps = torch.from_numpy(KDTree(positions).query(positions, _NEIGHBOURS + 1)[0][:, 1:].mean(1)).to(points)
    nearest = torch.from_numpy(KDTree(gaussians.means.cpu().numpy()).query(positions)[0]).to(points)
    lonely = nearest > gaps
    size = gaps[lonely, None]
    return gaussians.joined(_round(points[lonely], size, _POINT, colors[lonely]))


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
    return _round(means, size, _FILLED, mean(images))


def _round(means: Tensor, size: Tensor, opacity: float, colors: Tensor) -> Gaussians:
    """Round Gaussians at ``means [N, 3]`` of standard deviation ``size [N, 1]`` and of ``colors [N, 3]``."""
    return Gaussians(
        means,
        F.pad(torch.ones_like(size), (0, 3)),
        size.expand(-1, 3),
        torch.full_like(size[:, 0], opacity),
        rgb_to_sh(colors)[:, None],
        torch.zeros_like(size[:, 0], dtype=torch.int64),
    )
