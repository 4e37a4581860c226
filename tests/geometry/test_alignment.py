from dataclasses import replace

import torch
from torch import Tensor

from tests.geometry.test_cameras import random_cameras
from vg2gt.geometry.alignment import Similarity, align_cameras, align_points, fit_depth_scale, weighted_median
from vg2gt.geometry.cameras import project
from vg2gt.geometry.rotations import quat_to_matrix
from vg2gt.types import Cameras


def rand(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def randn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def random_similarity(scenes: int, seed: int = 7) -> Similarity:
    rotation = quat_to_matrix(randn(scenes, 4, seed=seed))
    return Similarity(0.3 + rand(scenes, seed=seed), rotation, randn(scenes, 3, seed=seed + 1))


def test_weighted_median_by_hand() -> None:
    values = torch.tensor([[3.0, 1.0, 2.0, torch.nan], [5.0, 5.0, 7.0, 1.0]])
    weights = torch.tensor([[1.0, 1.0, 5.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    found = weighted_median(values, weights)
    assert found[0] == 2
    assert found[1].isnan()


def test_scale_is_the_minimiser_of_the_weighted_l1_error() -> None:
    predicted, reference = 0.5 + rand(1, 2, 20, 30), 1 + 3 * rand(1, 2, 20, 30, seed=1)
    valid = rand(1, 2, 20, 30, seed=2) > 0.3
    reference[0, 0, 0, 0], valid[0, 0, 0, 0] = 0.002, True  # below the weights' smallest depth
    scale = float(fit_depth_scale(predicted, reference, valid)[0])

    def cost(s: float) -> float:
        p, d = predicted[valid], reference[valid]
        return float(((s * p - d).abs() / d.clamp(min=0.01)).sum())

    # A sum of absolute values is smallest at one of its kinks.
    best = min(cost(float(ratio)) for ratio in (reference / predicted)[valid])
    assert cost(scale) <= best + 1e-9
    # The unweighted median of the ratios is another number: the weights matter.
    assert abs(scale - float((reference / predicted)[valid].median())) > 1e-3


def test_scale_is_a_scenes_ignores_invalid_pixels_and_has_no_graph() -> None:
    predicted = 1 + rand(2, 3, 12, 10)
    factors = torch.tensor([[2.0, 2.0, 2.0], [0.5, 3.0, 0.5]], dtype=torch.float64)
    scale = fit_depth_scale(predicted, predicted * factors[..., None, None], predicted > 0)
    torch.testing.assert_close(scale, torch.tensor([2.0, 0.5], dtype=torch.float64))
    predicted, reference = 1 + rand(1, 1, 8, 8), 2 + rand(1, 1, 8, 8, seed=1)
    good = torch.ones_like(predicted, dtype=torch.bool)
    good[0, 0, :3] = False
    reference_scale = fit_depth_scale(predicted, reference, good)
    predicted[0, 0, 0], predicted[0, 0, 1], reference[0, 0, 2] = 0, torch.inf, torch.nan
    scale = fit_depth_scale(predicted.requires_grad_(), reference, torch.ones_like(good))
    torch.testing.assert_close(scale, reference_scale)
    assert not scale.requires_grad
    assert fit_depth_scale(predicted, reference, torch.zeros_like(good)).isnan().all()


def test_subsampling_takes_one_pixel_near_the_centre_of_every_cell():
    # 128 x 192 pixels: cells of 2 x 3, whose middle column is nearest to the centre.
    ratio = torch.full((1, 1, 128, 192), 50.0, dtype=torch.float64)
    ratio[..., 1::3] = 2.0
    assert float(fit_depth_scale(torch.ones_like(ratio), ratio, ratio > 0)[0]) == 2


def test_alignment_of_cameras_on_a_line_and_of_cameras_that_only_turn() -> None:
    predicted, truth = random_cameras(1, 5), random_similarity(1)
    for direction in (torch.tensor([0.3, 0.1, 0.2], dtype=torch.float64), torch.zeros(3, dtype=torch.float64)):
        centers = torch.arange(5, dtype=torch.float64)[:, None] * direction + 0.4
        poses = predicted.world_to_camera.clone()
        poses[0, :, :3, 3] = -(poses[0, :, :3, :3] @ centers[..., None])[..., 0]
        cameras = Cameras(poses, predicted.intrinsics, predicted.size)
        reference = truth.apply_cameras(cameras)
        found = align_cameras(cameras, reference)
        torch.testing.assert_close(found.rotation, truth.rotation)
        if direction.any():
            torch.testing.assert_close(found.scale, truth.scale)
            torch.testing.assert_close(found.apply_cameras(cameras).world_to_camera, reference.world_to_camera)
        else:
            torch.testing.assert_close(found.scale, torch.ones(1, dtype=torch.float64))


def test_scale_and_translation_are_least_squares_in_the_centres() -> None:
    predicted, truth = random_cameras(1, 6), random_similarity(1)
    exact = truth.apply_cameras(predicted).world_to_camera
    moved = exact.clone()
    moved[..., :3, 3] += 0.1 * randn(1, 6, 3, seed=9)
    reference = Cameras(moved, predicted.intrinsics, predicted.size)
    found = align_cameras(predicted, reference)
    torch.testing.assert_close(found.rotation, truth.rotation)

    def cost(similarity: Similarity) -> float:
        centers = [torch.linalg.inv(c.world_to_camera)[..., :3, 3] for c in (predicted, reference)]
        return float((similarity.apply(centers[0]) - centers[1]).square().sum())

    for step in (-1e-4, 1e-4):
        assert cost(replace(found, scale=found.scale + step)) > cost(found)
        for axis in torch.eye(3, dtype=torch.float64):
            assert cost(replace(found, translation=found.translation + step * axis)) > cost(found)


def test_alignment_never_mirrors() -> None:
    predicted, other = random_cameras(50, 3), random_cameras(50, 3, seed=20)  # nothing in common
    found = align_cameras(predicted, other)
    torch.testing.assert_close(torch.linalg.det(found.rotation), torch.ones(50, dtype=torch.float64))
    assert (found.scale > 0).all()


def test_a_similarity_moves_points_and_cameras_together() -> None:
    cameras, similarity = random_cameras(2, 3), random_similarity(2)
    points = randn(2, 3, 5, 3)
    pixels, depth = project(points, cameras)
    moved_pixels, moved_depth = project(similarity.apply(points), similarity.apply_cameras(cameras))
    torch.testing.assert_close(moved_pixels, pixels)
    torch.testing.assert_close(moved_depth, depth * similarity.scale[:, None, None])


def test_points_are_aligned_exactly_and_by_least_squares_if_noisy() -> None:
    points, truth = randn(3, 20, 3), random_similarity(3)
    found = align_points(points, truth.apply(points))
    for name in ("scale", "rotation", "translation"):
        torch.testing.assert_close(getattr(found, name), getattr(truth, name))
    # Noisy ones by Umeyama's closed form: singular values of the covariance over the variance.
    points, truth = randn(1, 60, 3), random_similarity(1)
    reference = truth.apply(points) + 0.1 * randn(1, 60, 3, seed=4)
    found = align_points(points, reference)
    x, y = (p[0] - p[0].mean(0) for p in (points, reference))
    u, d, vh = torch.linalg.svd(y.T @ x / 60)
    sign = torch.tensor([1.0, 1.0, float(torch.linalg.det(u @ vh).sign())], dtype=torch.float64)
    torch.testing.assert_close(found.rotation[0], u @ torch.diag(sign) @ vh)
    torch.testing.assert_close(found.scale[0], (d * sign).sum() / x.square().sum(1).mean())
    torch.testing.assert_close(found.apply(points).mean(1), reference.mean(1))
