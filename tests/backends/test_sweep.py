"""The plane sweep: its geometry, its kernels against their reference, its limits."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from backends.sweep.backend import SweepBackend
from backends.sweep.correlate import GROUPS, SourceWarp, correlate, correlate_reference
from backends.sweep.network import PosedViews
from backends.sweep.views import agreed_range, choose_sources, view_ranges, wide_range
from backends.sweep.volume import agreement
from examples.worlds import Worlds
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
    assert (agreement(inverse, warp)[:, 1][inner] > 0.99).float().mean() > 0.7  # the rest is outside of the sources
    nearer = inverse.clone()
    nearer[0] *= 1.1  # view 0 believes everything to be nearer than the others do
    difference = agreement(nearer, warp)[:, 2][inner]
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


def test_ranges() -> None:
    poses, _ = row_of_cameras(4)
    walk, _ = row_of_cameras(21)  # 4 long: something may stand as near as a step
    ranges = torch.stack((wide_range(poses), wide_range(walk)))
    torch.testing.assert_close(ranges, torch.tensor([[0.06, 24.0], [0.2, 160.0]]), rtol=1e-4, atol=0)
    close, _ = row_of_cameras(4, step=1e-4)
    close[0, 0, 3] = 1.0  # and one camera far away
    torch.testing.assert_close(wide_range(close), torch.tensor([0.03, 40.0]), rtol=1e-3, atol=0)
    depth = torch.cat((torch.linspace(2, 4, 1000), torch.full((1000,), 90.0)))
    agreeing = torch.cat((torch.ones(1000), torch.zeros(1000)))
    found = agreed_range(depth, agreeing, wide_range(poses))
    torch.testing.assert_close(found, torch.tensor([2.02 * 0.8, 3.98 * 1.4]), rtol=1e-2, atol=0)
    assert torch.equal(agreed_range(depth, 0 * agreeing, wide_range(poses)), wide_range(poses))


def test_views_that_overlap_little_search_nearer() -> None:
    """The last of four cameras looks where the others do, then to the side, then away from them."""
    poses, intrinsics = row_of_cameras(4)

    def near_of_the_last(turn: float) -> float:
        turned = poses.clone()
        cosine, sine = math.cos(turn), math.sin(turn)
        turned[3, :3] = torch.tensor([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]]) @ poses[3, :3]
        ranges = view_ranges(turned, intrinsics, (14, 22), torch.tensor([2.0, 9.0]))
        torch.testing.assert_close(ranges[:3], torch.tensor([[2.0, 9.0]]).repeat(3, 1))
        assert ranges[3, 1] == 9
        return float(ranges[3, 0])

    assert near_of_the_last(0.0) == 2
    assert 0.6 < near_of_the_last(0.7) < 2
    assert near_of_the_last(math.pi) == pytest.approx(0.6)


def test_depth_is_in_the_unit_of_the_cameras_and_those_in_one_place_are_refused(make_scene) -> None:
    """Metres or millimetres: the same network, the same depth in its unit."""
    backend = SweepBackend(pretrained=False)
    images, hints = make_scene(1, 3, (32, 48))
    given = Hints(cameras=hints.cameras)
    depth = backend.decode(backend.encode(images, given)).depth
    given.cameras.world_to_camera[..., :3, 3] *= 1000
    large = backend.decode(backend.encode(images, given)).depth
    torch.testing.assert_close(large / 1000, depth, rtol=2e-2, atol=0)
    given.cameras.world_to_camera[..., :3, 3] = 0
    with pytest.raises(ValueError, match=r"parallax, but .* all cameras are at the same position"):
        backend.encode(images, given)


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


@torch.no_grad()
def test_the_range_comes_from_the_cameras_and_a_given_one_is_searched_beyond(unseen_room: Batch) -> None:
    """Neither is anything cut off, nor do planes stand where nothing is; also where one camera is far from the rest."""
    network = SweepBackend().network
    cameras, images = unseen_room.cameras, unseen_room.images[0]
    features = network.features(images)
    low, high = (float(unseen_room.depth.quantile(q)) for q in (0.02, 0.98))
    alone = cameras.world_to_camera[0].clone()
    alone[-1, :3, 3] += alone[-1, :3, :3] @ torch.tensor([0.0, 8.0, 0.0])  # above the room, and turned away:
    alone[-1] = torch.diag(torch.tensor([-1.0, 1, -1, 1])) @ alone[-1]  # it sees nothing that others see
    for poses in (alone, cameras.world_to_camera[0]):
        views = PosedViews(images, poses, cameras.intrinsics[0])
        ranges = network.find_range(features, views, 3)
        assert torch.equal(ranges[:, 1], ranges[:1, 1].expand(8))
        (near, far), shortened = ranges[0].tolist(), ranges[:, 0] < 0.99 * ranges[:, 0].max()
        assert shortened.tolist() == [False] * 7 + [poses is alone]  # what it sees may be nearer
        assert 0.4 * low < near < 1.1 * low
        assert 0.9 * high < far < 2.5 * high
    # Sparse points miss what is near in few views; told too little, the sweep finds the rest.
    low, middle, high = (float(unseen_room.depth.quantile(q)) for q in (0.05, 0.5, 0.95))
    near, far = network.find_range(features, views, 3, torch.tensor([0.9 * middle, 1.1 * middle]))[0].tolist()
    wide = network.find_range(features, views, 3, torch.tensor([0.5 * low, 2 * high]))[0].tolist()
    assert 0.45 * middle * 0.8 <= near < max(low, 0.6 * middle)
    assert min(high, 1.4 * middle) < far < 3.3 * middle * 1.4
    assert wide[0] <= 0.5 * low
    assert wide[1] >= 2 * high


@torch.no_grad()
def test_a_given_range_is_not_prolonged_by_the_sky() -> None:
    """Sky agrees at any large depth, which once made the far end that a hint gives four times as far."""
    rows = [0, 2, 4, 6]
    scene = Worlds.variants["outdoor"](4, 14, (64, 128), False)
    frames = scene.render(rows, 1, samples=1)
    images = torch.stack([torch.from_numpy(np.asarray(frame.image)) for frame in frames]).permute(0, 3, 1, 2) / 255
    depth = torch.stack([torch.from_numpy(np.asarray(frame.depth)) for frame in frames])
    assert (depth == 0).float().mean() > 0.03  # sky
    near, far = 0.8 * depth[depth > 0].quantile(0.01), 1.4 * depth[depth > 0].quantile(0.99)
    poses = torch.from_numpy(scene.world_to_camera[rows]).float()
    views = PosedViews(images, poses, torch.from_numpy(scene.intrinsics).float().repeat(4, 1, 1))
    network = SweepBackend().network
    found = network.find_range(network.features(images), views, 3, torch.stack((near, far)).float())
    assert (found[:, 1] / far).tolist() == pytest.approx([1.0] * 4, rel=0.1)
