"""Surfel start: initialises a voxel's Gaussians on its surface, in closed form (our addition to the paper's head).

The surface normal is the direction of least variance of a voxel's points. The colour gradient along the surface is the
covariance of position and colour divided by the spread of positions, as in linear regression.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.geometry.symmetric import principal_direction
from vg2gt.types import TensorRecord, VoxelMoments

_UNIFORM_VARIANCE = 1 / 12  # cells^2; variance of points spread uniformly over a cell
_GRADIENT_RIDGE = 0.01 / 12  # cells^2; suppresses colour gradients of points that are closer together
_MIN_GRADIENT = 1e-4  # squared colour per squared cell; below it, the longest axis is the first axis of the frame
_SPACING = 1.2  # cells; n Gaussians in a row are _SPACING / n apart
ALONE = 0.41  # cells; standard deviation of a single Gaussian in a row
SHARED = 0.58  # cells; n Gaussians in a row have the standard deviation SHARED / n
GRAZING = 0.2  # smallest cosine between line of sight and normal in the footprint of a pixel on the surface
_LARGEST_REACH = 1.2  # largest extent of the points, relative to a full cell
MIN_REACH = 0.3  # smallest extent of the Gaussians, relative to a full cell, where a surface only touches the cell
THICKNESS = 0.06  # cells; standard deviation along the normal
COLOR_GAIN = 1.4  # factor on initial colour differences, since overlapping Gaussians blur their colours


@dataclass(frozen=True)
class SurfelStart(TensorRecord):
    """Initial parameters of K Gaussians in M voxels, without gradient; lengths in cells.

    Attributes:
        frame: ``[M, 3, 3]`` rotations, columns (direction of the colour gradient, normal x direction, normal).
        offsets: ``[M, K, 3]`` offsets from the points' mean position, in world axes.
        scales: ``[M, K, 3]`` standard deviations along the frame's axes.
        colors: ``[M, K, 3]`` differences from the mean colour.
    """

    frame: Tensor
    offsets: Tensor
    scales: Tensor
    colors: Tensor


@torch.no_grad()
def surfel_start(moments: VoxelMoments, splits: int) -> SurfelStart:
    """Places K Gaussians on every voxel's surface.

    Defined for every input: a single point, collinear points and coincident points give a disc facing the cameras.

    Args:
        moments: second moments of M voxels.
        splits: Gaussians per voxel, K >= 1.
    """
    frame, gradient, reach = surface_frame(moments)
    grid, scales = layout(splits, moments.spread.new_zeros(()))
    plane = frame[..., :2]  # [M, 3, 2]
    offsets = torch.einsum("mij,mj,kj->mki", plane, reach, grid)
    extent = F.pad(reach.clamp(min=MIN_REACH), (0, 1), value=1.0)  # [M, 3]: not along the normal
    scales = scales * extent[:, None]
    colors = COLOR_GAIN * torch.einsum("mki,mic->mkc", offsets, gradient)
    return SurfelStart(frame, offsets, scales, colors)  # [M, 3, 3], [M, K, 3], [M, K, 3], [M, K, 3]


def surface_frame(moments: VoxelMoments) -> tuple[Tensor, Tensor, Tensor]:
    """Returns frame, colour gradient and extent of the surface in every voxel.

    Returns:
        The frame ``[M, 3, 3]`` as in :class:`SurfelStart`, its first axis towards the brighter side, its third towards
        the cameras; the colour gradient ``[M, 3 (position), 3 (colour)]`` in the tangent plane, per cell; and the
        points' extent ``[M, 2]`` along the first two axes, 1 for a full cell, at most 1.2.
    """
    spread, cross, facing, normal = moments.spread, moments.cross, moments.facing, moments.normal
    tangent = _orthogonal(normal)
    plane = torch.stack((tangent, torch.linalg.cross(normal, tangent)), -1)  # [M, 3, 2]
    inside = plane.transpose(1, 2) @ spread @ plane  # [M, 2, 2]
    ridge = inside + _GRADIENT_RIDGE * torch.eye(2, dtype=spread.dtype, device=spread.device)
    determinant = ridge[:, 0, 0] * ridge[:, 1, 1] - ridge[:, 0, 1].square()
    adjugate = torch.stack((ridge[:, 1, 1], -ridge[:, 0, 1], -ridge[:, 0, 1], ridge[:, 0, 0]), -1).unflatten(-1, (2, 2))
    slope = adjugate @ (plane.transpose(1, 2) @ cross) / determinant[:, None, None]  # [M, 2, 3]: least squares
    change = slope @ slope.transpose(1, 2)
    along, strength = principal_direction(change[:, 0, 0], change[:, 0, 1], change[:, 1, 1])
    longest, _ = principal_direction(inside[:, 0, 0], inside[:, 0, 1], inside[:, 1, 1])
    along = torch.where((strength > _MIN_GRADIENT)[:, None], along, longest)
    darker = (slope.sum(-1) * along).sum(-1, keepdim=True) < 0
    along = torch.where(darker, -along, along)
    across = torch.stack((-along[:, 1], along[:, 0]), -1)
    axes = torch.stack((along, across), -1)  # [M, 2, 2], columns in the tangent plane
    frame = torch.cat((plane @ axes, normal[:, :, None]), -1)
    # add the footprint of a point's pixel, which grows as the surface tilts away from the line of sight
    sight = (frame.transpose(1, 2) @ facing[:, :, None])[..., 0]  # [M, 3], of unit length
    lean = sight[:, :2].square() / sight[:, 2:].clamp(min=GRAZING).square()
    variance = (axes * (inside @ axes)).sum(1) + (1 + lean) * moments.pixel[:, None].square() * _UNIFORM_VARIANCE
    reach = (variance / _UNIFORM_VARIANCE).clamp(0, _LARGEST_REACH**2).sqrt()  # [M, 2]
    return frame, plane @ slope, reach


def layout(splits: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Returns positions ``[K, 2]`` of K Gaussians in a cell of unit extent, in rows, and their scales ``[K, 3]``."""
    rows = max(1, round(math.sqrt(splits)))
    places, scales = [], []
    for row in range(rows):
        count = splits // rows + (row < splits % rows)
        across = (row - (rows - 1) / 2) * _SPACING / rows
        for number in range(count):
            places.append(((number - (count - 1) / 2) * _SPACING / count, across))
            scales.append((_width(count), _width(rows), THICKNESS))
    return like.new_tensor(places), like.new_tensor(scales)


def _width(count: int) -> float:
    return ALONE if count == 1 else SHARED / count


def _orthogonal(normal: Tensor) -> Tensor:
    """Returns a unit vector ``[M, 3]`` orthogonal to each unit vector."""
    smallest = normal.abs().argmin(-1, keepdim=True)
    axis = torch.zeros_like(normal).scatter(-1, smallest, 1.0)
    return F.normalize(torch.linalg.cross(normal, axis), dim=-1)
