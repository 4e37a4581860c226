"""The plane sweep: its geometry, its kernels against their reference, its shipped weights."""

import pytest
import torch
from torch import Tensor

from backends.sweep.backend import SweepBackend
from backends.sweep.correlate import GROUPS, SourceWarp, correlate, correlate_reference
from backends.sweep.views import choose_sources
from backends.sweep.volume import agreement
from vg2gt.data import SyntheticScenes
from vg2gt.types import Batch, Cameras, Hints

SIZE = (13, 22)


def row_of_cameras(views: int, step: float = 0.2) -> tuple[Tensor, Tensor]:
    """Cameras side by side that look the same way: ``[V, 4, 4]``, ``[V, 3, 3]``."""
    poses = torch.eye(4).repeat(views, 1, 1)
    poses[:, 0, 3] = -step * torch.arange(views)
    intrinsics = torch.tensor([[20.0, 0, 10.5], [0, 20.0, 6], [0, 0, 1]]).repeat(views, 1, 1)
    return poses, intrinsics


@pytest.fixture
def problem(make_scene) -> tuple[Tensor, Tensor, SourceWarp]:
    """Features, inverse depths (some of them behind the sources or outside) and correspondences of three views."""
    hints = make_scene(1, 3, SIZE)[1]
    generator = torch.Generator().manual_seed(1)
    features = torch.randn(3, 2 * GROUPS, *SIZE, generator=generator)
    inverse = torch.rand(3, 5, SIZE[0] * SIZE[1], generator=generator) * 8
    sources = torch.tensor([[1, 2], [0, 2], [1, 0]])
    return features, inverse, SourceWarp(hints.cameras.world_to_camera[0], hints.cameras.intrinsics[0], sources, SIZE)


def test_kernels_equal_the_reference(problem) -> None:
    features, inverse, warp = problem
    given = features.requires_grad_()
    for first in (0, 1):  # some views are those of all
        results = []
        for function in (correlate, correlate_reference):
            similarity, inside = function(given, inverse[first:], warp.select(slice(first, 3)))
            weight = torch.cos(torch.arange(similarity.numel()).float()).view_as(similarity)
            (gradient,) = torch.autograd.grad((similarity * weight).sum(), given)
            results.append((similarity.detach(), inside, gradient))
            every = function(given, inverse, warp)
            assert all(torch.equal(a[first:], b) for a, b in zip(every, (similarity, inside), strict=True))
        assert 0.2 < results[0][1].float().mean() < 0.95  # some points fall outside
        for kernel, reference in zip(*results, strict=True):
            torch.testing.assert_close(kernel, reference, rtol=1e-4, atol=1e-4)


def test_agreement_is_one_for_true_depth_and_signed_otherwise(make_scene) -> None:
    hints = make_scene(1, 3, SIZE)[1]
    sources = torch.tensor([[1, 2], [0, 2], [0, 1]])
    warp = SourceWarp(hints.cameras.world_to_camera[0], hints.cameras.intrinsics[0], sources, SIZE)
    inverse = 1 / hints.depth[0][:, None]
    inner = (..., slice(3, -3), slice(5, -5))
    assert (agreement(inverse, warp, 0.03)[:, 1][inner] > 0.99).float().mean() > 0.7  # the rest is outside
    nearer = inverse.clone()
    nearer[0] *= 1.1  # view 0 believes everything to be nearer than the others do
    difference = agreement(nearer, warp, 0.03)[:, 2][inner]
    assert (difference[0] <= 0).all()
    assert (difference[1:] >= 0).float().mean() > 0.9
    assert difference[0].mean() < -0.05


def test_sources_overlap_and_have_parallax() -> None:
    poses, intrinsics = row_of_cameras(5)
    turned = poses.clone()
    turned[4, :3, :3] = torch.diag(torch.tensor([-1.0, 1, -1]))  # looks the other way
    size, depth_range = (14, 22), torch.tensor([1.0, 10.0])
    sources = choose_sources(turned, intrinsics, size, depth_range, 3)
    assert sources.shape == (5, 3)
    assert all(view not in sources[view] for view in range(5))
    assert 4 not in sources[:4]
    still = poses.clone()
    still[1, 0, 3] = 0  # at the position of view 0: no parallax with it
    assert choose_sources(still, intrinsics, size, depth_range, 1)[0, 0] != 1


def test_sources_together_cover_the_view() -> None:
    """View 0 looks at what 1 and 2 see on the left and 3 on the right: the two best see the same half."""
    poses, intrinsics = row_of_cameras(4)
    turns = torch.tensor([0.0, 0.5, 0.5, -0.5])
    poses[:, 0, 0], poses[:, 0, 2] = turns.cos(), turns.sin()
    poses[:, 2, 0], poses[:, 2, 2] = -turns.sin(), turns.cos()
    poses[:, 0, 3] = torch.tensor([0.0, 0.5, 0.6, -0.2])
    size, depth_range = (14, 22), torch.tensor([2.0, 6.0])
    assert choose_sources(poses, intrinsics, size, depth_range, 3)[0].tolist() == [1, 3, 2]


@pytest.fixture(scope="module")
def unseen_room() -> Batch:
    """Eight views of a room that neither the backbone nor anything else was trained on."""
    frames = SyntheticScenes(1, 1_500_001, num_frames=16).load("room-1500001", range(0, 16, 2))
    cameras = Cameras(frames.world_to_camera[None], frames.intrinsics[None], (112, 224))
    return Batch(frames.images[None], frames.depth[None], cameras, torch.arange(8)[None], ("room-1500001",), 8)


def test_shipped_weights_measure_depth(unseen_room: Batch) -> None:
    """From images and cameras alone, metric, with a confidence that knows where it errs."""
    backend = SweepBackend()
    geometry = backend.decode(backend.encode(unseen_room.images, Hints(cameras=unseen_room.cameras)))
    error = (geometry.depth / unseen_room.depth - 1).abs().flatten()
    assert error.mean() < 0.12
    assert error.median() < 0.05
    order = geometry.depth_conf.flatten().argsort(descending=True)
    assert error[order[: len(order) // 2]].mean() < 0.6 * error.mean()
