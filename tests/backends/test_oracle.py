from dataclasses import replace

import torch

from backends.oracle import OracleBackend
from vg2gt.geometry.cameras import relative_to_first
from vg2gt.types import Geometry, Hints

SIZE = (56, 112)


def simulate(images: torch.Tensor, hints: Hints, **settings) -> Geometry:
    backend = OracleBackend(**settings)
    return backend.decode(backend.encode(images, hints))


def relative_error(images: torch.Tensor, hints: Hints, **settings) -> torch.Tensor:
    return simulate(images, hints, **settings).depth / hints.depth - 1


def test_without_noise_it_is_the_data(make_scene) -> None:
    images, hints = make_scene(2, 3, SIZE)
    geometry = simulate(images, hints, depth_noise=0)
    torch.testing.assert_close(geometry.depth, hints.depth)
    expected = relative_to_first(hints.cameras)
    torch.testing.assert_close(geometry.cameras.world_to_camera, expected.world_to_camera, rtol=0, atol=1e-6)
    assert torch.equal(geometry.cameras.intrinsics, hints.cameras.intrinsics)


def test_noise_has_the_stated_size_and_is_smooth(make_scene) -> None:
    images, hints = make_scene(4, 12, SIZE)
    error = relative_error(images, hints, depth_noise=0.02)
    assert 0.017 < error.square().mean().sqrt() < 0.023
    assert 0.006 < error.mean((-2, -1)).std() < 0.02  # a constant of every view is part of it
    assert error.diff(dim=-1).abs().mean() < 0.1 * error.abs().mean()


def test_noise_depends_on_seed_scene_and_frame_only(make_scene) -> None:
    images, hints = make_scene(2, 4, SIZE)
    error = relative_error(images, hints)
    order = torch.tensor([2, 0, 3, 1])  # another first view too
    flipped = replace(hints.map(lambda tensor: tensor[:, order].flip(0)), scene_key=hints.scene_key[::-1])
    again = relative_error(images[:, order].flip(0), flipped)
    torch.testing.assert_close(again, error[:, order].flip(0), rtol=0, atol=1e-6)
    other = relative_error(images, hints, seed=1)
    assert (other - error).abs().mean() > 0.005
    assert (error[0, 0] - error[1, 0]).abs().mean() > 0.002
    assert (error[0, 0] - error[0, 1]).abs().mean() > 0.002


def test_first_pose_is_exact_and_the_others_err_a_little(make_scene) -> None:
    images, hints = make_scene(4, 12, SIZE)
    geometry = simulate(images, hints, pose_noise=0.01)
    poses = geometry.cameras.world_to_camera
    assert torch.equal(poses[:, 0], torch.eye(4).expand(4, 4, 4))
    exact = relative_to_first(hints.cameras).world_to_camera
    error = poses[:, 1:] @ torch.linalg.inv(exact[:, 1:])
    turn = torch.stack((error[..., 2, 1], error[..., 0, 2], error[..., 1, 0]), -1)
    assert 0.004 < turn.std() < 0.006
    assert 0.015 < error[..., :3, 3].std() < 0.025  # 0.01 of a depth of about 2


def test_invalid_depth_stays_invalid(make_scene) -> None:
    images, hints = make_scene(1, 2, SIZE)
    depth = hints.depth.clone()
    depth[..., 20:40, 30:60] = 0
    depth[0, 1] = 0
    backend = OracleBackend()
    tokens = backend.encode(images, replace(hints, depth=depth))
    geometry = backend.decode(tokens.with_patch(tuple(patch + 1 for patch in tokens.patch)))
    assert torch.equal(geometry.depth == 0, depth == 0)
    assert geometry.depth_conf[depth == 0].max() < 0.01
    assert geometry.depth_conf[depth > 0].min() > 1
    assert all(torch.isfinite(patch).all() for patch in tokens.patch)


def test_tokens_do_not_know_the_truth(make_scene) -> None:
    """Two different truths that look the same to the network (same prediction) have the same tokens."""
    images, hints = make_scene(1, 2, SIZE)
    noisy = OracleBackend(depth_noise=0.05, pose_noise=0.0)
    exact = OracleBackend(depth_noise=0.0)
    first = noisy.encode(images, hints)
    second = exact.encode(images, replace(hints, depth=noisy.decode(first).depth))
    torch.testing.assert_close(second.state["depth"], first.state["depth"])
    apart = (first.patch[0] - second.patch[0]).abs().flatten(0, 2)
    assert torch.linalg.matrix_rank(apart, rtol=1e-3) == 1  # the confidence channel alone tells them apart
