"""Sparse depth at the points of a structure-from-motion model, without likely outliers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from vg2gt.data.sources.undistortion import pinhole_camera
from vg2gt.io import colmap_images, colmap_pose
from vg2gt.io.colmap import Camera, Image, Reconstruction

MIN_TRACK = 3
"""Minimum number of views that observe a point; two cannot reveal a wrong match."""
MAX_REPROJECTION = 2.0
"""Maximum reprojection error of an observation, in pixels of the model's images."""
MIN_ANGLE = 2.0
"""Minimum angle between a point's rays, in degrees.

Below it, half a pixel of noise at a focal length of 1000 gives a depth error of 1.5 %.
"""
MAX_GAP = 0.25
"""Maximum distance to a point's third-nearest neighbour, as a fraction of its distance from the cameras.

Points beyond it are isolated and count as outliers.
"""
_NEIGHBOURS = 3
_FAR = 1e30


class SparsePoints:
    """Image positions and depths of the points observed by each view.

    Positions are in the undistorted images, as a fraction of the image size. Frames are numbered in the order of the
    model's image names.

    Args:
        model: the structure-from-motion model.
        sound: leave out likely outliers: points with fewer than ``MIN_TRACK`` views or nearly parallel rays, isolated
            points, points whose reprojection error is too large in more than half of their views, and single
            observations with too large an error.
    """

    def __init__(self, model: Reconstruction, sound: bool = True) -> None:
        images = colmap_images(model)
        poses = np.array([colmap_pose(image) for image in images]).reshape(-1, 4, 4)
        scene = _Points.of(model, images)
        used: NDArray[np.bool_] = np.asarray((np.abs(scene.positions) < _FAR).all(1))
        if sound:
            used &= np.bincount(scene.owner, minlength=len(used)) >= MIN_TRACK
            used = used & (_ray_angles(scene, poses) >= MIN_ANGLE)
            used[used] = _near_others(scene, poses, used)
        observed = np.zeros(len(used), np.int64)  # observations per point
        agreeing = np.zeros(len(used), np.int64)  # of these, with a small reprojection error
        views = []
        for view, (image, pose) in enumerate(zip(images, poses, strict=True)):
            own = (scene.view == view) & used[scene.owner]
            rows, features, camera = scene.owner[own], scene.features[own], image.camera
            seen = scene.positions[rows] @ pose[:3, :3].T + pose[:3, 3]
            place = _undistorted(features, camera)
            inside = (place >= 0).all(1) & (place < 1).all(1)
            good = inside & (seen[:, 2] > 1e-6) & (seen[:, 2] < _FAR)
            if sound:
                error = np.linalg.norm(camera.img_from_cam(seen) - features, axis=1)
                good &= error <= MAX_REPROJECTION
                np.add.at(observed, rows[inside], 1)
                np.add.at(agreeing, rows[good], 1)
            views.append((rows[good], place[good], seen[good, 2].astype(np.float32)))
        agreed = 2 * agreeing >= observed
        self._views = [(place[agreed[rows]], depth[agreed[rows]]) for rows, place, depth in views]

    def places(self, frame: int) -> NDArray[np.float64]:
        """Returns the positions ``[n, 2]`` (x, y) of a frame's points, in [0, 1)."""
        return self._views[frame][0]

    def depth(self, frame: int) -> NDArray[np.float32]:
        """Returns the positive z-depths ``[n]`` of a frame's points."""
        return self._views[frame][1]


@dataclass(frozen=True)
class _Points:
    """Point positions ``[N, 3]``; point row, view and feature position in pixels ``[T, 2]`` of every observation."""

    positions: NDArray[np.float64]
    owner: NDArray[np.int64]
    view: NDArray[np.int64]
    features: NDArray[np.float64]

    @staticmethod
    def of(model: Reconstruction, images: Sequence[Image]) -> _Points:
        """Collects the points of a model and their observations in ``images``."""
        points = model.points3D
        row_of = {number: row for row, number in enumerate(points)}
        rows, views, features = [], [], []
        for view, image in enumerate(images):
            for feature in image.get_observation_points2D():
                if feature.point3D_id not in row_of:  # the model's file of points is missing
                    continue
                rows.append(row_of[feature.point3D_id])
                views.append(view)
                features.append(feature.xy)
        positions = np.array([point.xyz for point in points.values()], np.float64).reshape(-1, 3)
        where = np.array(features, np.float64).reshape(-1, 2)
        return _Points(positions, np.array(rows, np.int64), np.array(views, np.int64), where)


def _undistorted(features: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Returns positions ``[n, 2]`` of features in the undistorted image, as a fraction of its size."""
    target = pinhole_camera(camera)
    rays = camera.cam_from_img(np.ascontiguousarray(features))
    return target.img_from_cam(np.concatenate((rays, np.ones((len(rays), 1))), 1)) / (target.width, target.height)


def _rays(scene: _Points, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the vectors ``[T, 3]`` from the points to the cameras that observe them; NaN if a pose is unknown."""
    centers = -(poses[:, :3, :3].swapaxes(1, 2) @ poses[:, :3, 3:])[..., 0]
    return centers[scene.view] - scene.positions[scene.owner]


def _ray_angles(scene: _Points, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns twice the largest angle (degrees) of a point's rays to their mean ``[N]``; for two rays, their angle."""
    owner, count = scene.owner, len(scene.positions)
    with np.errstate(all="ignore"):
        rays = _rays(scene, poses)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        known = np.isfinite(rays).all(1)
        mean = np.zeros((count, 3))
        np.add.at(mean, owner[known], rays[known])
        mean /= np.linalg.norm(mean, axis=1, keepdims=True)
        cosine = (rays * mean[owner]).sum(1).clip(-1, 1)
        angles = np.zeros(count)
        np.maximum.at(angles, owner[known], 2 * np.degrees(np.arccos(cosine[known])))
    return np.nan_to_num(angles, nan=180.0)  # opposite rays have no mean direction


def _near_others(scene: _Points, poses: NDArray[np.float64], used: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Returns which of the used points have close neighbours; all of them if there are too few to decide."""
    positions = scene.positions[used]
    if len(positions) <= 10 * _NEIGHBOURS:
        return np.ones(len(positions), bool)
    distance = np.full(len(used), np.inf)
    np.fmin.at(distance, scene.owner, np.linalg.norm(_rays(scene, poses), axis=1))
    gap = np.asarray(KDTree(positions).query(positions, _NEIGHBOURS + 1)[0])[:, -1]
    return gap <= MAX_GAP * distance[used]
