"""Depth at the points of a structure-from-motion model, without those that are likely to be wrong."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from vg2gt.io import ColmapCamera, ColmapImage, ColmapModel, colmap_intrinsics, colmap_pose

MIN_TRACK = 3
"""Views that must see a point before its depth counts: two are not enough to notice a wrong match."""
MAX_REPROJECTION = 2.0
"""Pixels of the model's images that a point may lie from where a view saw it."""
MIN_ANGLE = 2.0
"""Degrees between a point's rays: with half a pixel of noise at a focal length of 1000, less leaves 1.5 % of depth."""
MAX_GAP = 0.25
"""Part of its distance from the cameras that a point's third neighbour may be away: others float alone."""
_NEIGHBOURS = 3
_FAR = 1e30


class SparsePoints:
    """The points that each view saw, by frame number: where in the image, as a part of its size, and how deep.

    Args:
        model: frames are numbered in the order of its images' names.
        sound: leave out what is likely to be wrong: points of few views, of nearly parallel rays, alone in space or
            that half of the images saw elsewhere, and observations that a point does not project to.
    """

    def __init__(self, model: ColmapModel, sound: bool = True) -> None:
        used: NDArray[np.bool_] = np.asarray((np.abs(model.points.positions) < _FAR).all(1))
        if sound:
            used &= (model.points.track_lengths >= MIN_TRACK) & (model.points.track_lengths > 0)
            used = used & (_ray_angles(model) >= MIN_ANGLE)
            used[used] = _near_others(model, used)
        order = np.argsort(model.points.ids)
        observed = np.zeros(len(model.points), np.int64)  # in images
        agreeing = np.zeros(len(model.points), np.int64)  # and where the point projects to
        views = []
        for record in in_order(model):
            camera, pose = model.cameras[record.camera_id], colmap_pose(record)
            row = np.searchsorted(model.points.ids, record.point3d_ids, sorter=order).clip(max=len(order) - 1)
            known = np.zeros(len(row), bool)
            if len(order):
                known = (model.points.ids[order[row]] == record.point3d_ids) & used[order[row]]
            rows = order[row[known]]
            seen = model.points.positions[rows] @ pose[:3, :3].T + pose[:3, 3]
            place = record.points2d[known] / (camera.width, camera.height)
            inside = (place >= 0).all(1) & (place < 1).all(1)
            good = inside & (seen[:, 2] > 1e-6) & (seen[:, 2] < _FAR)
            if sound:
                good &= _reprojection(seen, camera, record.points2d[known]) <= MAX_REPROJECTION
                np.add.at(observed, rows[inside], 1)
                np.add.at(agreeing, rows[good], 1)
            views.append((rows[good], place[good], seen[good, 2].astype(np.float32)))
        agreed = 2 * agreeing >= observed
        self._views = [(place[agreed[rows]], depth[agreed[rows]]) for rows, place, depth in views]

    def places(self, frame: int) -> NDArray[np.float64]:
        """``[n, 2]`` (x, y) in [0, 1)."""
        return self._views[frame][0]

    def depth(self, frame: int) -> NDArray[np.float32]:
        """``[n]`` positive z-depth."""
        return self._views[frame][1]


def in_order(model: ColmapModel) -> list[ColmapImage]:
    """A model's images by name, the order of frames."""
    return sorted(model.images.values(), key=lambda image: image.name)


def _reprojection(
    seen: NDArray[np.float64], camera: ColmapCamera, points2d: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Pixels ``[n]`` between points in the camera's frame and where they were seen."""
    depth = np.maximum(seen[:, 2:], 1e-6)
    projected = (seen / depth) @ colmap_intrinsics(camera)[:2].T + 0.5  # features count from the corner
    return np.linalg.norm(projected - points2d, axis=1)


def _rays(model: ColmapModel) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """From the points to the cameras that saw them ``[T, 3]``, and the points' rows ``[T]``; unknown images: NaN."""
    names = np.array(list(model.images), np.int64)
    poses = np.array([colmap_pose(image) for image in model.images.values()]).reshape(-1, 4, 4)
    centers = np.concatenate((-(poses[:, :3, :3].swapaxes(1, 2) @ poses[:, :3, 3:])[..., 0], np.full((1, 3), np.nan)))
    order = np.argsort(names)
    wanted = model.points.tracks[:, 0]
    place = np.searchsorted(names, wanted, sorter=order).clip(max=len(names) - 1)
    image = np.where(names[order[place]] == wanted, order[place], len(names)) if len(names) else np.zeros(0, np.int64)
    owner = np.repeat(np.arange(len(model.points)), model.points.track_lengths)
    return centers[image] - model.points.positions[owner], owner


def _ray_angles(model: ColmapModel) -> NDArray[np.float64]:
    """Twice the largest angle in degrees of a point's rays to their mean ``[N]``: of two rays, that between them."""
    with np.errstate(all="ignore"):
        rays, owner = _rays(model)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        known = np.isfinite(rays).all(1)
        mean = np.zeros((len(model.points), 3))
        np.add.at(mean, owner[known], rays[known])
        mean /= np.linalg.norm(mean, axis=1, keepdims=True)
        cosine = (rays * mean[owner]).sum(1).clip(-1, 1)
        angles = np.zeros(len(model.points))
        np.maximum.at(angles, owner[known], 2 * np.degrees(np.arccos(cosine[known])))
    return np.nan_to_num(angles, nan=180.0)  # rays from all sides have no mean


def _near_others(model: ColmapModel, used: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Of the used points, which have others near by; all of them where there are too few to tell."""
    positions = model.points.positions[used]
    if len(positions) <= 10 * _NEIGHBOURS:
        return np.ones(len(positions), bool)
    rays, owner = _rays(model)
    distance = np.full(len(model.points), np.inf)
    np.fmin.at(distance, owner, np.linalg.norm(rays, axis=1))
    gap = np.asarray(KDTree(positions).query(positions, _NEIGHBOURS + 1)[0])[:, -1]
    return gap <= MAX_GAP * distance[used]
