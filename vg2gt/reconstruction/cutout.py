"""Cuts a scene to the object that its cameras look at."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from vg2gt.geometry.cameras import camera_centers, project, unproject

if TYPE_CHECKING:
    from torch import Tensor

    from vg2gt.reconstruction.scene import Scene

_FACING = 0.8  # share of the cameras that must have the middle of the object in their image
_SEEN = 0.9  # share of the cameras that must have a Gaussian in their image
_NEAR = 0.8  # of the distance of the nearest cameras from the middle: nothing farther from it belongs to the object
_CELLS = 48  # cells of the grid along its longest side, in which neighbours are found
_SOLID = 0.1  # opacity of what holds an object together


def cut_to_object(scene: Scene) -> Scene:
    """Returns a scene without what is not part of the object in the middle of its views.

    The middle is the median of what is in the middle of the images. What almost all cameras see around it, nearer to it
    than they are, and connected, is the object; floating debris and surroundings go, and so does their depth. Meshes of
    it are closed (:func:`vg2gt.io.solid.fuse_solid`).

    Raises:
        ValueError: if the cameras do not look at one place.
    """
    cameras = scene.cameras.to("cpu")
    means = scene.gaussians.means.detach().cpu()
    middle = _middle(scene)
    if middle is None or _share_of_views(scene, middle[None])[0] < _FACING:
        raise ValueError(
            "the cameras do not look at one object, as they do when you walk around it: leave --object away, or mask "
            "the object"
        )
    nearest = float(np.quantile((camera_centers(cameras)[0].double() - middle).norm(dim=-1), 0.1))
    inside = ((means.double() - middle).norm(dim=-1) < _NEAR * nearest) & (_share_of_views(scene, means) >= _SEEN)
    solid = inside & (scene.gaussians.opacities.detach().cpu() > _SOLID)
    if not solid.any():
        raise ValueError("nothing is where all cameras look at: leave --object away")
    low, high = (corner.double().numpy() for corner in torch.aminmax(means[solid], dim=0))
    step = float((high - low).max()) / _CELLS or 1.0
    grid = np.zeros((np.ceil((high - low) / step).astype(int) + 1).tolist(), bool)
    cells = _cells(means[solid], low, step)
    grid[tuple(cells.T)] = True
    labels: NDArray[np.int32] = np.zeros(grid.shape, np.int32)
    ndimage.label(grid, np.ones((3, 3, 3)), output=labels)
    largest = int(np.bincount(labels[tuple(cells.T)])[1:].argmax()) + 1
    kept_cells = np.asarray(ndimage.binary_dilation(labels == largest, np.ones((3, 3, 3))), bool)

    def belongs(points: Tensor) -> Tensor:
        place = _cells(points, low, step)
        known = np.all((place >= 0) & (place < np.array(grid.shape)), axis=1)
        return torch.from_numpy(known & kept_cells[tuple(np.where(known[:, None], place, 0).T)])

    depth = scene.depth.clone()
    for view, own in enumerate(depth):
        seen = own > 0
        own[seen] *= belongs(unproject(own[None, None], cameras.select(slice(view, view + 1)))[0, 0][seen])
    rows = (inside & belongs(means)).to(scene.gaussians.means.device)
    return replace(scene, gaussians=scene.gaussians.select(rows), depth=depth, is_object=True)


def _cells(points: Tensor, low: NDArray[np.float64], step: float) -> NDArray[np.int64]:
    return np.floor((points.double().numpy() - low) / step + 0.5).astype(np.int64)


def _middle(scene: Scene) -> Tensor | None:
    """Returns the median ``[3]`` of what is in the middle ninth of the images; None if nothing is."""
    height, width = scene.depth.shape[1:]
    rows, columns = slice(height // 3, height - height // 3), slice(width // 3, width - width // 3)
    world = unproject(scene.depth[None].double(), scene.cameras.to("cpu").map(torch.Tensor.double))[0]
    seen = world[:, rows, columns][scene.depth[:, rows, columns] > 0]
    return seen.median(0).values if len(seen) else None


def _share_of_views(scene: Scene, points: Tensor) -> Tensor:
    """Returns the share of the views, ``[N]``, that have points ``[N, 3]`` in their image."""
    height, width = scene.cameras.size
    count = torch.zeros(len(points))
    for view in range(len(scene.names)):
        pixels, z = project(points[None, None].float(), scene.cameras.to("cpu").select(slice(view, view + 1)))
        x, y = pixels[0, 0].unbind(-1)
        count += (z[0, 0] > 0) & (x >= -0.5) & (y >= -0.5) & (x < width - 0.5) & (y < height - 0.5)
    return count / len(scene.names)
