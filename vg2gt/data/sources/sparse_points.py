"""Depth at the points of a structure-from-motion model, without those that are likely to be wrong."""

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
        model: frames are numbered in the order of its images' names. Places are those of the undistorted images.
        sound: leave out what is likely to be wrong: points of few views, of nearly parallel rays, alone in space or
            that half of the images saw elsewhere, and observations that a point does not project to.
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
        observed = np.zeros(len(used), np.int64)  # in images
        agreeing = np.zeros(len(used), np.int64)  # and where the point projects to
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
        """``[n, 2]`` (x, y) in [0, 1)."""
        return self._views[frame][0]

    def depth(self, frame: int) -> NDArray[np.float32]:
        """``[n]`` positive z-depth."""
        return self._views[frame][1]


@dataclass(frozen=True)
class _Points:
    """``positions [N, 3]``, and every observation: its point's row, its view, and the feature in pixels ``[T, 2]``."""

    positions: NDArray[np.float64]
    owner: NDArray[np.int64]
    view: NDArray[np.int64]
    features: NDArray[np.float64]

    @staticmethod
    def of(model: Reconstruction, images: Sequence[Image]) -> _Points:
        """The points of a model and what each of ``images`` observed of them."""
        points = model.points3D
        row_of = {number: row for row, number in enumerate(points)}
        rows, views, features = [], [], []
        for view, image in enumerate(images):
            for feature in image.get_observation_points2D():
                if feature.point3D_id not in row_of:  # a model without its file of points
                    continue
                rows.append(row_of[feature.point3D_id])
                views.append(view)
                features.append(feature.xy)
        positions = np.array([point.xyz for point in points.values()], np.float64).reshape(-1, 3)
        where = np.array(features, np.float64).reshape(-1, 2)
        return _Points(positions, np.array(rows, np.int64), np.array(views, np.int64), where)


def _undistorted(features: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Places ``[n, 2]`` of features in the undistorted image, as a part of its size."""
    target = pinhole_camera(camera)
    rays = camera.cam_from_img(np.ascontiguousarray(features))
    return target.img_from_cam(np.concatenate((rays, np.ones((len(rays), 1))), 1)) / (target.width, target.height)


def _rays(scene: _Points, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """From the points to the cameras that saw them ``[T, 3]``; NaN where a pose is unknown."""
    centers = -(poses[:, :3, :3].swapaxes(1, 2) @ poses[:, :3, 3:])[..., 0]
    return centers[scene.view] - scene.positions[scene.owner]


def _ray_angles(scene: _Points, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Twice the largest angle in degrees of a point's rays to their mean ``[N]``: of two rays, that between them."""
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
    return np.nan_to_num(angles, nan=180.0)  # rays from all sides have no mean


def _near_others(scene: _Points, poses: NDArray[np.float64], used: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Of the used points, which have others near by; all of them where there are too few to tell."""
    positions = scene.positions[used]
    if len(positions) <= 10 * _NEIGHBOURS:
        return np.ones(len(positions), bool)
    distance = np.full(len(used), np.inf)
    np.fmin.at(distance, scene.owner, np.linalg.norm(_rays(scene, poses), axis=1))
    gap = np.asarray(KDTree(positions).query(positions, _NEIGHBOURS + 1)[0])[:, -1]
    return gap <= MAX_GAP * distance[used]
