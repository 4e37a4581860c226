"""Sparse depth at the points of a structure-from-motion model, without likely outliers."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from vg2gt.data.sources.undistortion import pinhole_camera
from vg2gt.io import colmap_images, colmap_pose
from vg2gt.io.colmap import Camera, Reconstruction

_MIN_TRACK = 3
"""Minimum number of views that observe a point; two cannot reveal a wrong match."""
_MAX_REPROJECTION = 2.0
"""Maximum reprojection error of an observation, in pixels of the model's images."""
MIN_ANGLE = 2.0
"""Minimum angle between two of a point's rays, in degrees.

Below it, half a pixel of noise at a focal length of 1000 gives a depth error of 1.5 %.
"""
_MAX_GAP = 0.25
"""Maximum distance to a point's third-nearest neighbour, as a fraction of its distance from the cameras.

Points beyond it are isolated and count as outliers.
"""
_NEIGHBOURS = 3
_FAR = 1e30


@dataclass(frozen=True)
class ObservedPoints:
    """Points that one view observes.

    Attributes:
        numbers: ``[n]`` number of each point, the same in all views.
        places: ``[n, 2]`` positions (x, y) in the undistorted image as a fraction of its size, in [0, 1).
        depth: ``[n]`` positive z-depths.
    """

    numbers: NDArray[np.int64]
    places: NDArray[np.float64]
    depth: NDArray[np.float32]


class SparsePoints:
    """Image positions and depths of the points observed by each view.

    Positions are in the undistorted images, as a fraction of the image size. Frames are numbered in the order of the
    model's image names.

    Args:
        model: the structure-from-motion model; not changed.
        sound: leave out likely outliers: points with fewer than ``_MIN_TRACK`` views or nearly parallel rays, isolated
            points, points whose reprojection error is too large in more than half of their views, and single
            observations with too large an error.
    """

    def __init__(self, model: Reconstruction, sound: bool = True) -> None:
        model = _without_outliers(model) if sound else model
        points = {number: point.xyz for number, point in model.points3D.items()}
        views = []
        for image in colmap_images(model):
            observed = [feature for feature in image.get_observation_points2D() if feature.point3D_id in points]
            owner = np.array([feature.point3D_id for feature in observed], np.int64)
            features = np.array([feature.xy for feature in observed]).reshape(-1, 2)
            pose = colmap_pose(image)
            seen = np.array([points[number] for number in owner]).reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]
            places, depth = _undistorted(features, image.camera), seen[:, 2]
            inside = (places >= 0).all(1) & (places < 1).all(1)
            good = inside & (depth > 1e-6) & (depth < _FAR)
            if sound:
                good &= np.linalg.norm(image.camera.img_from_cam(seen) - features, axis=1) <= _MAX_REPROJECTION
            views.append((owner[inside], places[inside], depth[inside].astype(np.float32), good[inside]))
        owners, rows = np.unique(np.concatenate([view[0] for view in views]), return_inverse=True)
        agreeing = np.bincount(rows, np.concatenate([view[3] for view in views]), len(owners))
        agreed = owners[2 * agreeing >= np.bincount(rows, minlength=len(owners))] if sound else owners
        kept = [good & np.isin(owner, agreed) for owner, _, _, good in views]
        self._views = [
            ObservedPoints(*(each[rows] for each in view[:3])) for view, rows in zip(views, kept, strict=True)
        ]

    def of(self, frame: int) -> ObservedPoints:
        """Returns the points that a frame observes."""
        return self._views[frame]


def _undistorted(features: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Returns positions ``[n, 2]`` of features in the undistorted image, as a fraction of its size."""
    target = pinhole_camera(camera)
    rays = camera.cam_from_img(np.ascontiguousarray(features))
    return target.img_from_cam(np.concatenate((rays, np.ones((len(rays), 1))), 1)) / (target.width, target.height)


def _without_outliers(model: Reconstruction) -> Reconstruction:
    import pycolmap  # pyright: ignore[reportMissingImports]

    model = deepcopy(model)
    manager = pycolmap.ObservationManager(model)
    manager.filter_points3D_with_short_tracks(_MIN_TRACK)
    manager.filter_points3D_with_small_triangulation_angle(MIN_ANGLE, model.point3D_ids())
    points = dict(model.points3D)
    if len(points) <= 10 * _NEIGHBOURS:  # too few to tell which are isolated
        return model
    centers = {number: image.projection_center() for number, image in model.images.items()}
    distances = [
        min(np.linalg.norm(centers[element.image_id] - point.xyz) for element in point.track.elements)
        for point in points.values()
    ]
    positions = np.array([point.xyz for point in points.values()])
    gaps = np.asarray(KDTree(positions).query(positions, _NEIGHBOURS + 1)[0])[:, -1]
    for number in np.array(list(points))[gaps > _MAX_GAP * np.array(distances)]:
        model.delete_point3D(number)
    return model
