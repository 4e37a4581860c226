"""Our addition to the paper's coarse module: distance of each point from the surface that all views agree on.

The voxels around a point contain the points of other views, so the frozen geometry itself reveals a view's depth error
along its rays. It is passed as ``SURFACE_CHANNELS`` inputs per point and ``CENTROID_CHANNELS`` inputs per voxel. With
``model.coarse.gate`` the module changes nothing where views agree (docs/concepts/deviations.md).
"""

from __future__ import annotations

import torch
from torch import Tensor

from vg2gt.geometry.cameras import ray_directions
from vg2gt.geometry.normals import normals_from_depth
from vg2gt.method.grid import VoxelPlan, pool_mean, scene_counts
from vg2gt.types import Cameras

CENTROID_CHANNELS = 3  # per voxel: centroid of its points in the cell
SURFACE_CHANNELS = 5  # per point: vector to the surface in camera axes (3), change of depth (1), confidence (1)
_SURFACE_WIDTH = 2.0  # voxels; standard deviation of the Gaussian weights of the voxels around a point
_DEPTH_CHANGE_UNIT = 0.02  # relative to the depth
_MAX_DEPTH_CHANGE = 3.0  # in _DEPTH_CHANGE_UNIT
GRAZING = 0.2  # product of normal and ray below which the change of depth is unreliable
_NORMAL_EDGE = 0.2  # relative depth step across which no normal is computed
_GATE_OPEN = 0.4  # disagreement in _DEPTH_CHANGE_UNIT at which the gate is 1
_GATE_POWER = 3.0
_GATE_MOST = 1.5  # largest gate


class PointFrames:
    """Depth, ray, surface normal and camera rotation of packed points, each in the view it comes from.

    Args:
        depth: ``[B, V, h, w]`` in scene units, 0 = invalid.
        cameras: cameras of these pixels.
        rows: ``[N]`` index of each point in the flattened ``[B, V, h, w]`` grid.
    """

    def __init__(self, depth: Tensor, cameras: Cameras, rows: Tensor) -> None:
        height, width = depth.shape[-2:]
        self.depth = torch.where(depth > 0, depth, 1.0).flatten()[rows]
        self.ray = ray_directions(cameras.intrinsics, (height, width)).flatten(0, -2)[rows]
        normals, known = normals_from_depth(depth, cameras.intrinsics, _NORMAL_EDGE)  # [B, V, 3, h, w], [B, V, h, w]
        normals = torch.where(known[:, :, None], normals, normals.new_tensor([0.0, 0.0, -1.0])[:, None, None])
        self.normal = normals.permute(0, 1, 3, 4, 2).flatten(0, -2)[rows]
        self.rotation = cameras.world_to_camera[..., :3, :3].flatten(0, 1)[rows // (height * width)]

    def in_camera(self, to_surface: Tensor, voxel_size: Tensor) -> Tensor:
        """Returns the vectors to the surface in camera axes (voxels), and as changes of depth.

        The change of depth moves a point along its ray to the tangent plane at the end of its vector. It measures only
        how far the views disagree, and does not depend on where on the surface the neighbours lie.

        Args:
            to_surface: ``[N, 3]`` in world axes and voxels.
            voxel_size: ``[N]`` scene units per voxel.

        Returns:
            ``[N, 4]``. The change is positive for a surface behind the point, in units of ``_DEPTH_CHANGE_UNIT`` of the
            depth, clamped to ``_MAX_DEPTH_CHANGE`` of them, and 0 where the ray grazes the surface.
        """
        local = (self.rotation @ to_surface[..., None])[..., 0]
        facing = (self.normal * self.ray).sum(-1)
        steps = (self.normal * local).sum(-1) / facing
        change = steps * voxel_size / (self.depth * _DEPTH_CHANGE_UNIT)
        change = torch.where(facing < -GRAZING, change, 0.0).clamp(-_MAX_DEPTH_CHANGE, _MAX_DEPTH_CHANGE)
        return torch.cat((local, change[:, None]), -1)


def disagreement(change: Tensor, usable: Tensor, batch: Tensor, scenes: int) -> Tensor:
    """Returns the median absolute change of depth ``[B]`` over the usable points of each scene; 0 if there are none.

    Args:
        change: ``[N]`` in units of ``_DEPTH_CHANGE_UNIT``, as :meth:`PointFrames.in_camera` gives it.
        usable: ``[N]`` bool.
        batch: ``[N]`` scene index, sorted.
        scenes: B.
    """
    rows = usable.nonzero()[:, 0]
    parts = change[rows].abs().split(scene_counts(batch[rows], scenes).tolist())
    return torch.stack([part.median() if len(part) else change.new_zeros(()) for part in parts])


def gate(disagreement: Tensor) -> Tensor:
    """Returns the factor ``[B]`` on changes: close to 0 where views agree, so that accurate depth is preserved.

    Its constants were chosen on six rooms and two recordings with 0 to 5 % noise (docs/results.md).
    """
    return (disagreement / _GATE_OPEN).pow(_GATE_POWER).clamp(max=_GATE_MOST)


def cell_centroids(cells: Tensor, confidence: Tensor, plan: VoxelPlan) -> Tensor:
    """Returns the confidence-weighted mean position ``[M, 3]`` of points relative to the cell centre, in [-1/2, 1/2].

    Args:
        cells: ``[N, 3]`` float64 positions in voxels.
        confidence: ``[N]`` > 0.
        plan: the voxels.
    """
    return pool_mean((cells - cells.floor() - 0.5).float(), confidence, plan)


def voxel_evidence(confidence: Tensor, plan: VoxelPlan) -> Tensor:
    """Returns the evidence of every voxel: the sum ``[M]`` of its points' squared confidences ``[N]``."""
    return confidence.new_zeros(len(plan)).index_add_(0, plan.voxel_of, confidence.square())


def vectors_to_surface(queries: Tensor, centroids: Tensor, evidence: Tensor, index: Tensor) -> Tensor:
    """Returns the vector ``[N, 3]``, in voxels, from every point to the surface that all views agree on around it.

    The inverse-square weights used for features would select the point's own voxel. Gaussian weights average several
    voxels, and squared confidences as evidence let confident points dominate.

    Args:
        queries: ``[N, 3]`` positions of the points, in voxels.
        centroids: ``[M, 3]`` positions of the voxels' centroids, in voxels.
        evidence: ``[N, k]`` evidence of the neighbours, 0 where there is none.
        index: ``[N, k]`` the neighbours' rows in ``centroids``.
    """
    offset = centroids[index] - queries[:, None]  # [N, k, 3]
    weights = evidence * torch.exp(offset.square().sum(-1) / (-2 * _SURFACE_WIDTH**2))  # [N, k]
    weights = weights / weights.sum(1, keepdim=True).clamp(min=1e-12)
    return (weights[..., None] * offset).sum(1)
