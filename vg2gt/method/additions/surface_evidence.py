"""Our addition to the paper's coarse module: how far each view is from the surface that all views agree on.

The voxels around a point hold the other views' points, so a view's depth error along its ray shows in the frozen
geometry itself: ``SURFACE_CHANNELS`` numbers a point, and ``CENTROID_CHANNELS`` more inputs of the voxels. Where views
agree, ``model.coarse.gate`` keeps the module from changing anything (docs/concepts/deviations.md).
"""

from __future__ import annotations

import torch
from torch import Tensor

from vg2gt.geometry.cameras import ray_directions
from vg2gt.geometry.normals import normals_from_depth
from vg2gt.method.grid import VoxelPlan, pool_mean, scene_counts
from vg2gt.types import Cameras

CENTROID_CHANNELS = 3  # of a voxel: its points' centroid in the cell
SURFACE_CHANNELS = 5  # of a point: a vector to the surface in camera axes (3), a change of depth; confidence
SURFACE_WIDTH = 2.0  # voxels, of the Gaussian that weighs the voxels around a point
DEPTH_CHANGE_UNIT = 0.02  # relative
MAX_DEPTH_CHANGE = 3.0  # units
GRAZING = 0.2  # product of normal and ray below which the change of depth says nothing
NORMAL_EDGE = 0.2  # relative depth step across which no normal is taken
GATE_OPEN = 0.4  # units of disagreement at which changes are taken as they are
GATE_POWER = 3.0
GATE_MOST = 1.5


class PointFrames:
    """How packed points lie in the views that see them.

    Args:
        depth: ``[B, V, h, w]`` scene units, 0 = invalid.
        cameras: of these pixels.
        rows: ``[N]`` the packed points' places in the flattened ``[B, V, h, w]`` grid.
    """

    def __init__(self, depth: Tensor, cameras: Cameras, rows: Tensor) -> None:
        height, width = depth.shape[-2:]
        self.depth = torch.where(depth > 0, depth, 1.0).flatten()[rows]
        self.ray = ray_directions(cameras.intrinsics, (height, width)).flatten(0, -2)[rows]
        normals, known = normals_from_depth(depth, cameras.intrinsics, NORMAL_EDGE)  # [B, V, 3, h, w], [B, V, h, w]
        normals = torch.where(known[:, :, None], normals, normals.new_tensor([0.0, 0.0, -1.0])[:, None, None])
        self.normal = normals.permute(0, 1, 3, 4, 2).flatten(0, -2)[rows]
        self.rotation = cameras.world_to_camera[..., :3, :3].flatten(0, 1)[rows // (height * width)]

    def in_camera(self, to_surface: Tensor, voxel_size: Tensor) -> Tensor:
        """The vectors to the surface in the cameras' axes (voxels), and as changes of depth.

        The change of depth takes the point along its ray onto the tangent plane through the vector's end, so that
        where on the surface the neighbours happen to lie drops out: what remains is how far the views disagree.

        Args:
            to_surface: ``[N, 3]`` in world axes and voxels.
            voxel_size: ``[N]`` scene units per voxel.

        Returns:
            ``[N, 4]``; the change is positive for a surface behind the point, in units of ``DEPTH_CHANGE_UNIT`` of the
            depth, at most ``MAX_DEPTH_CHANGE`` of them, and 0 where the ray grazes the surface.
        """
        local = (self.rotation @ to_surface[..., None])[..., 0]
        facing = (self.normal * self.ray).sum(-1)
        steps = (self.normal * local).sum(-1) / facing
        change = steps * voxel_size / (self.depth * DEPTH_CHANGE_UNIT)
        change = torch.where(facing < -GRAZING, change, 0.0).clamp(-MAX_DEPTH_CHANGE, MAX_DEPTH_CHANGE)
        return torch.cat((local, change[:, None]), -1)

    def evidence(
        self, to_surface: Tensor, voxel_size: Tensor, batch: Tensor, clear: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """What :meth:`in_camera` gives ``[N, 4]``, and the gate ``[B]`` on what the network changes.

        Args:
            to_surface: ``[N, 3]`` in world axes and voxels.
            voxel_size: ``[B]`` scene units per voxel.
            batch: ``[N]`` scene index, sorted.
            clear: ``[N]`` bool, points away from silhouettes; others have evidence 0. None: no gate, and all count.
        """
        seen = self.in_camera(to_surface, voxel_size[batch])
        if clear is None:
            return seen, torch.ones_like(voxel_size)
        seen = torch.where(clear[:, None], seen, 0)
        return seen, gate(disagreement(seen[:, -1], clear, batch, len(voxel_size)))


def disagreement(change: Tensor, usable: Tensor, batch: Tensor, scenes: int) -> Tensor:
    """Median size ``[B]`` of the changes of depth ``[N]`` towards the agreed surface, of the usable points; 0 of none.

    Args:
        change: ``[N]`` in units of ``DEPTH_CHANGE_UNIT``, as :meth:`PointFrames.in_camera` gives it.
        usable: ``[N]`` bool.
        batch: ``[N]`` scene index, sorted.
        scenes: B.
    """
    rows = usable.nonzero()[:, 0]
    parts = change[rows].abs().split(scene_counts(batch[rows], scenes).tolist())
    return torch.stack([part.median() if len(part) else change.new_zeros(()) for part in parts])


def gate(disagreement: Tensor) -> Tensor:
    """Factor ``[B]`` on what is changed: next to nothing where views agree, so that clean depth stays clean.

    Its constants were chosen on six rooms and two recordings with 0 to 5 % noise (docs/results.md).
    """
    return (disagreement / GATE_OPEN).pow(GATE_POWER).clamp(max=GATE_MOST)


def cell_centroids(cells: Tensor, confidence: Tensor, plan: VoxelPlan) -> Tensor:
    """Confidence-weighted mean ``[M, 3]`` of the points' places in their cell, from its centre, in [-1/2, 1/2].

    Args:
        cells: ``[N, 3]`` float64 positions in voxels.
        confidence: ``[N]`` > 0.
        plan: the voxels.
    """
    return pool_mean((cells - cells.floor() - 0.5).float(), confidence, plan)


def voxel_evidence(confidence: Tensor, plan: VoxelPlan) -> Tensor:
    """How much the points of a voxel know together: the sum ``[M]`` of their squared confidences ``[N]``."""
    return confidence.new_zeros(len(plan)).index_add_(0, plan.voxel_of, confidence.square())


def vectors_to_surface(queries: Tensor, centroids: Tensor, evidence: Tensor, index: Tensor) -> Tensor:
    """From every point to the surface that all views agree on around it, ``[N, 3]`` in voxels.

    The features' inverse-square weights would return the point's own voxel; a Gaussian of the distance keeps several,
    and confident points, of which the square of the confidence is the evidence, outweigh the others.

    Args:
        queries: ``[N, 3]`` the points, in voxels.
        centroids: ``[M, 3]`` positions of the voxels' centroids, in voxels.
        evidence: ``[N, k]`` of the neighbours, 0 where there is none.
        index: ``[N, k]`` the neighbours' rows of ``centroids``.
    """
    offset = centroids[index] - queries[:, None]  # [N, k, 3]
    weights = evidence * torch.exp(offset.square().sum(-1) / (-2 * SURFACE_WIDTH**2))  # [N, k]
    weights = weights / weights.sum(1, keepdim=True).clamp(min=1e-12)
    return (weights[..., None] * offset).sum(1)
