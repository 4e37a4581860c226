"""Density control: fewer Gaussians where views do not support them, more where one is not enough."""

from __future__ import annotations

import torch
from torch import Tensor

from vg2gt.geometry.rotations import matrix_to_quat, quat_to_matrix
from vg2gt.method.additions.far_shell import is_far
from vg2gt.method.additions.surfel import ALONE, layout
from vg2gt.method.additions.visibility import count_points
from vg2gt.method.grid import plan_voxels, point_cells, pool_mean
from vg2gt.refinement.parameters import Parameters
from vg2gt.types import Cameras, Gaussians

TOLERANCE, MARGIN = 0.03, 0.05  # relative depth differences at which a view agrees with a Gaussian, or looks through it
FEWEST = 2  # minimum number of views that agree with Gaussians to merge
GROWTH = 2.0  # factor on merged standard deviations: neighbours overlap, and refinement has to add the detail
OPACITY = 0.5  # of merged Gaussians


def supported(gaussians: Gaussians, cameras: Cameras, depth: Tensor, views: int, merge_cells: float = 0.0) -> Gaussians:
    """Returns the Gaussians that enough views agree with and no more look through; all if there are none.

    Depth without texture is unreliable, and with many views some of its errors agree by chance. Refined as they are,
    such small Gaussians fit their source views and become floaters in all others; merged, they become smooth.

    Args:
        gaussians: the scene (B = 1).
        cameras: cameras of its V views (B = 1).
        depth: ``[V, H, W]`` depth of the views, 0 = unknown.
        views: minimum number of views that agree, capped at half of V.
        merge_cells: merge Gaussians that fewer, but at least two views agree with, in cells this many times as wide as
            what the median Gaussian covers; 0: remove them.
    """
    agree, through = count_points(gaussians.means, depth, cameras, TOLERANCE, MARGIN)
    far = is_far(gaussians, depth, cameras)  # the far shell behind everything stays
    keep = (agree >= min(views, len(depth) // 2)) & (through <= agree) | far
    weak = (agree >= min(FEWEST, len(depth) // 2)) & (through <= agree) & ~keep
    if not keep.any():
        return gaussians
    kept = gaussians.select(keep)
    if not merge_cells or not weak.any():
        return kept
    sizes = gaussians.scales[~far].max(-1).values
    return kept.joined(merged(gaussians.select(weak), merge_cells * float(sizes.median()) / ALONE))


def merged(gaussians: Gaussians, cell: float) -> Gaussians:
    """Merges the Gaussians of each cell into one: mean and covariance of their mixture, weighted by opacity, widened.

    The moments are those of Kerbl et al., A Hierarchical 3D Gaussian Representation (2024).

    Args:
        gaussians: one scene (B = 1).
        cell: edge of the cells in scene units.
    """
    cells = point_cells(gaussians.means, gaussians.batch, gaussians.means.new_tensor([cell]))
    plan = plan_voxels(cells, gaussians.batch, torch.ones_like(gaussians.batch, dtype=torch.bool))

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


def prune(parameters: Parameters, min_opacity: float) -> int:
    """Removes Gaussians below ``min_opacity``, unless all are; returns their number."""
    opacities = torch.sigmoid(parameters.values["opacities"].detach())
    keep = opacities >= min_opacity
    if keep.all() or not keep.any():
        return 0
    parameters.take(keep.nonzero()[:, 0])
    return int((~keep).sum())


@torch.no_grad()
def split(parameters: Parameters, count: int) -> int:
    """Splits the ``count`` Gaussians with the largest position gradients in two; returns the number of splits.

    The halves are laid out along the longest axis like the Gaussians of a voxel (self-split, K = 2): 0.3 cells to
    either side and 0.7 times as long. A cell is what a single Gaussian covers.
    """
    pull = parameters.pull()
    chosen = pull.topk(min(count, len(pull))).indices
    chosen = chosen[pull[chosen] > 0].sort().values
    if not len(chosen):
        return 0
    longest, shift = _along_longest(parameters, chosen)
    places, scales = layout(2, parameters.unit)
    rest = torch.ones_like(pull, dtype=torch.bool)
    rest[chosen] = False
    parameters.take(torch.cat((rest.nonzero()[:, 0], chosen, chosen)))
    halves = parameters.values["means"].detach()[-2 * len(chosen) :].unflatten(0, (2, -1))
    halves += places[:, :1, None] * shift
    logs = parameters.values["scales"].detach()[-2 * len(chosen) :].unflatten(0, (2, -1))
    logs += (scales[0, 0] / ALONE).log() * longest
    return len(chosen)


def _along_longest(parameters: Parameters, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the longest axis, ``[N, 3]`` one-hot, and the cell along it, ``[N, 3]`` in the units of the positions."""
    scales = parameters.values["scales"].detach()[rows].exp()
    length, axis = scales.max(-1)
    longest = torch.nn.functional.one_hot(axis, 3).to(scales.dtype)
    direction = (quat_to_matrix(parameters.values["quats"].detach()[rows]) * longest[:, None]).sum(-1)
    return longest, direction * (length / ALONE / parameters.unit[rows])[:, None]
