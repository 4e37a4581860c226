"""Sparse points as depth: what is likely to be wrong is left out, what is right stays."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vg2gt.data.sources.sparse_points import MIN_ANGLE, SparsePoints
from vg2gt.io import ColmapCamera, ColmapImage, ColmapModel, ColmapPoints

VIEWS, POINTS, FOCAL = 5, 400, 500.0
CAMERA = ColmapCamera(1, "PINHOLE", 640, 480, (FOCAL, FOCAL, 320.0, 240.0))


def model_of(baseline: float = 1.0, seed: int = 0) -> ColmapModel:
    """Points in a box 4 to 6 units before cameras in a row that turn towards its middle; features off by 0.3 pixels."""
    rng = np.random.default_rng(seed)
    positions = rng.uniform((-1, -1, 4), (1, 1, 6), (POINTS, 3))
    ids = np.arange(1, POINTS + 1)
    images = {}
    for view in range(VIEWS):
        x = baseline * (view / (VIEWS - 1) - 0.5)
        rotation = Rotation.from_euler("y", np.arctan2(x, 5.0))
        translation = -rotation.as_matrix() @ [x, 0, 0]
        seen = positions @ rotation.as_matrix().T + translation
        features = FOCAL * seen[:, :2] / seen[:, 2:] + (320, 240) + rng.normal(0, 0.3, (POINTS, 2))
        quaternion = rotation.as_quat()[[3, 0, 1, 2]]
        images[view + 1] = ColmapImage(view + 1, tuple(quaternion), tuple(translation), 1, f"{view}.png", features, ids)
    tracks = np.stack(np.broadcast_arrays(np.arange(1, VIEWS + 1)[None], np.arange(POINTS)[:, None]), -1).reshape(-1, 2)
    colors, errors = np.zeros((POINTS, 3), np.uint8), np.full(POINTS, -1.0)
    points = ColmapPoints(ids, positions, colors, errors, tracks, np.full(POINTS, VIEWS))
    return ColmapModel({1: CAMERA}, images, points)


def errors_of(found: SparsePoints, right: SparsePoints) -> np.ndarray:
    """Relative errors of the depths that ``found`` has, by the places that both know."""
    errors = []
    for view in range(VIEWS):
        truth = {tuple(place): depth for place, depth in zip(right.places(view), right.depth(view), strict=True)}
        told = zip(found.places(view), found.depth(view), strict=True)
        errors += [abs(depth / truth[tuple(place)] - 1) for place, depth in told]
    return np.array(errors)


def count(points: SparsePoints) -> int:
    return sum(len(points.depth(view)) for view in range(VIEWS))


def test_what_is_right_stays() -> None:
    model = model_of()
    assert count(SparsePoints(model)) > 0.99 * count(SparsePoints(model, sound=False))


@pytest.mark.parametrize("factor", [0.5, 1.1, 3.0])
def test_points_at_a_wrong_depth_go(factor: float) -> None:
    """Moved along the first view's rays, where they still project to what was seen."""
    model = model_of()
    right = SparsePoints(model, sound=False)
    wrong = np.random.default_rng(1).random(POINTS) < 0.2
    first = model.images[1]
    turn = Rotation.from_quat(np.array(first.quat)[[1, 2, 3, 0]]).as_matrix()
    center = -turn.T @ first.translation
    positions = model.points.positions.copy()
    positions[wrong] = center + factor * (positions[wrong] - center)
    damaged = replace(model, points=replace(model.points, positions=positions))
    before = errors_of(SparsePoints(damaged, sound=False), right)
    after = errors_of(SparsePoints(damaged), right)
    assert (before > 0.03).mean() > 0.1
    assert (after > 0.03).mean() == 0
    assert len(after) > 0.75 * len(before)


def test_nearly_parallel_rays_do_not_count() -> None:
    near = np.radians(MIN_ANGLE) * 5 / 3
    assert not count(SparsePoints(model_of(baseline=near)))
    assert count(SparsePoints(model_of(baseline=4 * near))) > 0.9 * VIEWS * POINTS


def test_points_alone_in_space_go() -> None:
    """Seen alike by all views, which is what a reflection or something that moves may look like."""
    model = model_of()
    images = {}
    lone = np.array([0.0, 0.0, 2.0])
    positions = model.points.positions.copy()
    positions[7] = lone
    for number, image in model.images.items():
        turn = Rotation.from_quat(np.array(image.quat)[[1, 2, 3, 0]]).as_matrix()
        seen = turn @ lone + image.translation
        features = image.points2d.copy()
        features[7] = FOCAL * seen[:2] / seen[2] + (320, 240)
        images[number] = replace(image, points2d=features)
    found = SparsePoints(replace(model, images=images, points=replace(model.points, positions=positions)))
    assert min(found.depth(view).min() for view in range(VIEWS)) > 3


def test_a_model_without_points_has_no_depth() -> None:
    model = model_of()
    images = {number: replace(image, point3d_ids=np.full(POINTS, -1)) for number, image in model.images.items()}
    assert not count(SparsePoints(replace(model, images=images, points=ColmapPoints.empty())))
