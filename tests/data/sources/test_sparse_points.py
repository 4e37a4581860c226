"""Sparse points as depth: what is likely to be wrong is left out, what is right stays."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from vg2gt.data.sources.sparse_points import MIN_ANGLE, SparsePoints
from vg2gt.io import colmap_from_views
from vg2gt.types import Cameras

VIEWS, POINTS, FOCAL = 5, 400, 500.0
K = np.array([[FOCAL, 0, 319.5], [0, FOCAL, 239.5], [0, 0, 1]])


def poses_of(baseline: float) -> np.ndarray:
    """Cameras in a row that turn towards the middle of the points."""
    poses = np.tile(np.eye(4), (VIEWS, 1, 1))
    for view, pose in enumerate(poses):
        x = baseline * (view / (VIEWS - 1) - 0.5)
        pose[:3, :3] = Rotation.from_euler("y", np.arctan2(x, 5.0)).as_matrix()
        pose[:3, 3] = -pose[:3, :3] @ [x, 0, 0]
    return poses


def model_of(
    baseline: float = 1.0,
    moved: Callable[[np.ndarray], np.ndarray] = lambda positions: positions,
    seen_as: Callable[[np.ndarray], np.ndarray] = lambda positions: positions,
    observed: bool = True,
):
    """Points in a box 4 to 6 units before the cameras, features off by 0.3 pixels."""
    rng = np.random.default_rng(0)
    positions = rng.uniform((-1, -1, 4), (1, 1, 6), (POINTS, 3))
    poses = poses_of(baseline)
    seen = np.einsum("vij,nj->vni", poses[:, :3, :3], seen_as(positions)) + poses[:, None, :3, 3]
    pixels = FOCAL * seen[..., :2] / seen[..., 2:] + K[:2, 2] + rng.normal(0, 0.3, (VIEWS, POINTS, 2))
    cameras = Cameras(torch.from_numpy(poses)[None], torch.from_numpy(K).repeat(1, VIEWS, 1, 1), (480, 640))
    owner, views = np.tile(np.arange(POINTS), VIEWS), np.repeat(np.arange(VIEWS), POINTS)
    names = [f"{view}.png" for view in range(VIEWS)]
    sources = (owner, views, pixels.reshape(-1, 2)) if observed else None
    return colmap_from_views(cameras, names, moved(positions), sources=sources)


def errors_of(found: SparsePoints, right: SparsePoints) -> np.ndarray:
    """Relative errors of the depths that ``found`` has, by the places that both know."""
    errors = []
    for view in range(VIEWS):
        truth = {tuple(place): depth for place, depth in zip(right.of(view).places, right.of(view).depth, strict=True)}
        told = zip(found.of(view).places, found.of(view).depth, strict=True)
        errors += [abs(depth / truth[tuple(place)] - 1) for place, depth in told]
    return np.array(errors)


def count(points: SparsePoints) -> int:
    return sum(len(points.of(view).depth) for view in range(VIEWS))


def test_what_is_right_stays_and_without_observations_there_is_no_depth() -> None:
    model = model_of()
    assert count(SparsePoints(model)) > 0.99 * count(SparsePoints(model, sound=False))
    assert not count(SparsePoints(model_of(observed=False)))


@pytest.mark.parametrize("factor", [0.5, 1.1, 3.0])
def test_points_at_a_wrong_depth_go(factor: float) -> None:
    """Moved along the first view's rays, where they still project to what was seen."""
    right = SparsePoints(model_of(), sound=False)
    wrong = np.random.default_rng(1).random(POINTS) < 0.2
    first = poses_of(1.0)[0]
    center = -first[:3, :3].T @ first[:3, 3]

    def moved(positions: np.ndarray) -> np.ndarray:
        return np.where(wrong[:, None], center + factor * (positions - center), positions)

    damaged = model_of(moved=moved)
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

    def one_alone(positions: np.ndarray) -> np.ndarray:
        return np.where(np.arange(POINTS)[:, None] == 7, [0.0, 0.0, 2.0], positions)

    found = SparsePoints(model_of(moved=one_alone, seen_as=one_alone))
    assert min(found.of(view).depth.min() for view in range(VIEWS)) > 3
