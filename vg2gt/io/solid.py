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

MOST_VOXELS = 8_000_000
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
        voxel_size: edge length of a voxel in scene units; larger if there were more than :data:`MOST_VOXELS`.

    Returns:
        The mesh of the largest part; empty if there is none.
    """
    low, high = (corner.double() for corner in bounds)
    volume = float((high - low).clamp(min=voxel_size).prod())
    voxel_size = max(voxel_size, (volume / MOST_VOXELS) ** (1 / 3))
    first, last = (low / voxel_size).floor().long() - _MARGIN, (high / voxel_size).ceil().long() + _MARGIN
    axes = [torch.arange(int(a), int(b) + 1) for a, b in zip(first, last, strict=True)]
    index = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    centers = ((index + 0.5) * voxel_size).float().reshape(-1, 3)
    total, shade, near, free = (torch.zeros(len(centers), *shape) for shape in ((), (3,), (), ()))
    cameras = cameras.map(lambda tensor: tensor.detach().cpu().float())
    for view in range(len(depth)):
        pixels, z = (each[0, 0] for each in project(centers[None, None], cameras.select(slice(view, view + 1))))
        x, y = pixels.round().long().unbind(-1)
        inside = (z > 0) & (x >= 0) & (y >= 0) & (x < depth.shape[2]) & (y < depth.shape[1])
        rows = inside.nonzero()[:, 0]
        x, y = x[rows], y[rows]
        distance = (depth[view, y, x] - z[rows]) / (_TRUNCATION * voxel_size)
        known = depth[view, y, x] > 0
        free[rows] += (empty[view, y, x] | (known & (distance >= 1))).float()
        measured = known & (distance.abs() < 1)
        rows, distance = rows[measured], distance[measured]
        near[rows] += 1
        total[rows] += distance
        shade[rows] += colors[view][:, y[measured], x[measured]].T
    shape = tuple(len(axis) for axis in axes)
    average = (total + free) / (near + free).clamp(min=1)
    values = torch.where(near > 0, average, torch.where(free >= _FREE, 1.0, -1.0)).reshape(shape).numpy()
    shades = (shade / near.clamp(min=1)[:, None]).reshape(*shape, 3).numpy()
    smooth = np.empty_like(values)
    ndimage.gaussian_filter(values, _SMOOTH, output=smooth)
    found = _largest(smooth)
    nearest = np.zeros((3, *shape), np.int32)  # the voxel with a colour that is nearest to each
    unknown = (near == 0).reshape(shape).numpy()
    ndimage.distance_transform_edt(unknown, return_distances=False, return_indices=True, indices=nearest)
    joined = np.concatenate((found[..., None], shades[tuple(nearest)]), -1)
    return surface_of(index.reshape(-1, 3), torch.from_numpy(joined.reshape(-1, 4)), voxel_size)


def _largest(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns distances with the border of the grid and all parts but the largest empty."""
    inside = np.zeros(values.shape, bool)
    inside[1:-1, 1:-1, 1:-1] = values[1:-1, 1:-1, 1:-1] < 0
    labels: NDArray[np.int32] = np.zeros(values.shape, np.int32)
    ndimage.label(inside, output=labels)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return np.where((labels == sizes.argmax()) & inside, values, np.abs(values) + 1e-3).astype(np.float32)
