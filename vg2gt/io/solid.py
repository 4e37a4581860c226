"""A closed mesh of an object: space carving by depth and silhouettes; what no view has seen is inside.

Curless and Levoy (1996) close holes in the same way: a voxel is empty where views see through it, and solid elsewhere.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from vg2gt.geometry.cameras import project
from vg2gt.io.mesh import Mesh, surface_of
from vg2gt.types import Cameras

_MOST_VOXELS = 8_000_000
_TRUNCATION = 3.0  # voxels on either side of a surface in which views measure a distance
_SMOOTH = 0.7  # standard deviation of the filter against steps, in voxels
_MARGIN = 3  # empty voxels around the object
_FREE = 2  # views that see through a voxel without a measured distance, at least


def fuse_solid(
    depth: Tensor, empty: Tensor, cameras: Cameras, colors: Tensor, bounds: tuple[Tensor, Tensor], voxel_size: float
) -> Mesh:
    """Fuses views of an object into a closed mesh; where it was not seen, such as below, it ends flat.

    Args:
        depth: ``[V, H, W]`` measured z-depth, 0 where it is unknown.
        empty: ``[V, H, W]`` bool, pixels through which nothing of the object is seen.
        cameras: cameras of the V views (B = 1), of the maps' size.
        colors: ``[V, 3, H, W]`` in [0, 1].
        bounds: corners ``[3]`` of the object's box.
        voxel_size: edge length of a voxel in scene units; larger if there were more than 8 million.

    Returns:
        The mesh of the largest part; empty if there is none.
    """
    index, shape, voxel_size = _grid(bounds, voxel_size)
    centers = ((index + 0.5) * voxel_size).float()
    cameras = cameras.map(lambda tensor: tensor.detach().cpu().float())
    evidence = _Evidence(len(centers))
    for view in range(len(depth)):
        camera = cameras.select(slice(view, view + 1))
        evidence.add(centers, camera, depth[view], empty[view], colors[view], _TRUNCATION * voxel_size)
    smooth = np.empty(shape, np.float32)
    ndimage.gaussian_filter(evidence.distances().view(shape).numpy(), _SMOOTH, output=smooth)
    joined = np.concatenate((_largest(smooth)[..., None], evidence.shades(shape)), -1)
    return surface_of(index, torch.from_numpy(joined.reshape(-1, 4)), voxel_size)


def _grid(bounds: tuple[Tensor, Tensor], voxel_size: float) -> tuple[Tensor, tuple[int, ...], float]:
    """Returns the indices ``[N, 3]`` of the voxels of a box with a margin, their number per axis, and their size."""
    low, high = (corner.double() for corner in bounds)
    volume = float((high - low).clamp(min=voxel_size).prod())
    voxel_size = max(voxel_size, (volume / _MOST_VOXELS) ** (1 / 3))
    first, last = (low / voxel_size).floor().long() - _MARGIN, (high / voxel_size).ceil().long() + _MARGIN
    axes = [torch.arange(int(a), int(b) + 1) for a, b in zip(first, last, strict=True)]
    index = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return index, tuple(len(axis) for axis in axes), voxel_size


class _Evidence:
    """What views say of each of N voxels.

    Attributes:
        near: number of views that measure a distance to a surface close by.
        total: sum of these distances, in truncation distances, positive in front of the surface.
        free: number of views that see through the voxel.
        shade: sum of the colours where a distance is measured ``[N, 3]``.
    """

    def __init__(self, count: int) -> None:
        self.near, self.total, self.free = torch.zeros(3, count)
        self.shade = torch.zeros(count, 3)

    def add(
        self, centers: Tensor, camera: Cameras, depth: Tensor, empty: Tensor, colors: Tensor, truncation: float
    ) -> None:
        """Adds one view; ``truncation`` is the largest measured distance in scene units."""
        pixels, z = (each[0, 0] for each in project(centers[None, None], camera))
        x, y = pixels.round().long().unbind(-1)
        inside = (z > 0) & (x >= 0) & (y >= 0) & (x < depth.shape[1]) & (y < depth.shape[0])
        rows = inside.nonzero()[:, 0]
        x, y = x[rows], y[rows]
        distance, known = (depth[y, x] - z[rows]) / truncation, depth[y, x] > 0
        self.free[rows] += (empty[y, x] | (known & (distance >= 1))).float()
        measured = known & (distance.abs() < 1)
        rows = rows[measured]
        self.near[rows] += 1
        self.total[rows] += distance[measured]
        self.shade[rows] += colors[:, y[measured], x[measured]].T

    def distances(self) -> Tensor:
        """Returns mean distances ``[N]``: 1 where views only see through, -1 where nothing was seen."""
        average = (self.total + self.free) / (self.near + self.free).clamp(min=1)
        return torch.where(self.near > 0, average, torch.where(self.free >= _FREE, 1.0, -1.0))

    def shades(self, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """Returns mean colours ``[*shape, 3]``; a voxel without one has that of the nearest voxel with one."""
        mean = (self.shade / self.near.clamp(min=1)[:, None]).view(*shape, 3).numpy()
        nearest = np.zeros((3, *shape), np.int32)
        unknown = (self.near == 0).view(shape).numpy()
        ndimage.distance_transform_edt(unknown, return_distances=False, return_indices=True, indices=nearest)
        return mean[tuple(nearest)]


def _largest(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns distances with the border of the grid and all parts but the largest empty."""
    inside = np.zeros(values.shape, bool)
    inside[1:-1, 1:-1, 1:-1] = values[1:-1, 1:-1, 1:-1] < 0
    labels: NDArray[np.int32] = np.zeros(values.shape, np.int32)
    ndimage.label(inside, output=labels)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return np.where((labels == sizes.argmax()) & inside, values, np.abs(values) + 1e-3).astype(np.float32)
