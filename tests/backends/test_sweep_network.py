"""The plane sweep: its planes, its fused kernel against torch, the contract of its tokens."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from backends.sweep import SweepBackend
from backends.sweep.correlate import SourceWarp
from backends.sweep.network import PosedViews, SweepEncoding, SweepNet
from backends.sweep.planes import FARTHEST, PLANES, Planes
from backends.sweep.refine import RESPONSE
from backends.sweep.stage import Matching
from backends.sweep.views import baselines, sources_of
from vg2gt.data import SyntheticScenes
from vg2gt.geometry.cameras import resize_intrinsics
from vg2gt.types import Cameras, Hints

SIZE = (32, 48)


@pytest.fixture
def network() -> SweepNet:
    """Random weights, also where training begins with zeros."""
    torch.manual_seed(0)
    net = SweepNet()
    with torch.no_grad():
        for parameter in net.parameters():
            if not parameter.any():
                parameter.normal_(0, 0.02)
    return net


def posed(make_scene, views: int = 4, scene: int = 0) -> PosedViews:
    images, hints = make_scene(scene + 1, views, SIZE)
    return PosedViews(images[scene], hints.cameras.world_to_camera[scene], hints.cameras.intrinsics[scene])


def encode(net: SweepNet, views: PosedViews, shown: Tensor | None = None, count: int = 6) -> SweepEncoding:
    sources = sources_of(views.world_to_camera, views.intrinsics, views.size, count)
    return net.encode(net.features(views.images), views, sources, shown)


def test_planes_reach_from_infinity_to_a_fraction_of_the_baseline() -> None:
    """Far planes are spaced evenly in disparity, near ones in log-depth; positions are inverted exactly."""
    planes = Planes(torch.tensor([0.5, 3.0]))
    position = torch.linspace(0, 1, PLANES).view(1, -1, 1, 1).expand(2, -1, -1, -1)
    inverse = planes.inverse(position)
    assert (inverse[:, -1].flatten() * torch.tensor([0.5, 3.0])).tolist() == pytest.approx([1 / 0.15] * 2, rel=1e-4)
    assert (inverse[:, 0].flatten() * torch.tensor([0.5, 3.0]) < 1 / 1000).all()
    torch.testing.assert_close(planes.position(-inverse.log()), position.clamp_min(FARTHEST), rtol=1e-3, atol=1e-5)
    disparity, ratio = inverse.diff(dim=1), (inverse[:, 1:] / inverse[:, :-1]).log()
    assert float(disparity[0, 1] / disparity[0, 4]) == pytest.approx(0.77, abs=0.05)
    assert float(ratio[0, -1] / ratio[0, -5]) == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize(
    ("places", "expected"),
    [
        ([0.0, 1, 2, 3], [2, 1, 1, 2]),
        ([0.0, 5, 10, 15], [10, 5, 5, 10]),
        ([0.0, 0, 0.1, 10, 15], [10, 10, 9.9, 9.9, 14.9]),  # the first three are nearly in one place
        ([0.0, 0, 4], [4, 4, 4]),
        ([0.0, 1, 2, 3, 900], [2, 1, 1, 2, 898]),  # one is far away
    ],
)
def test_baselines_are_in_the_unit_of_the_cameras(places: list[float], expected: list[float]) -> None:
    poses = torch.eye(4).repeat(len(places), 1, 1)
    poses[:, 0, 3] = torch.tensor(places)
    assert baselines(poses).tolist() == pytest.approx(expected)


def test_views_from_one_place_are_no_sources_of_each_other(make_scene) -> None:
    """One of those that show the same is a source of others; those that are left are taken several times."""
    views = posed(make_scene, 5)
    poses = views.world_to_camera[[0, 0, 0, 1, 2]]
    for turned in (False, True):
        if turned:  # by 10 degrees: it shows something else
            poses[2] = (
                torch.linalg.matrix_exp(torch.tensor([[0, 0, 0.17, 0], [0] * 4, [-0.17, 0, 0, 0], [0] * 4])) @ poses[2]
            )
        found = sources_of(poses, views.intrinsics, views.size)
        assert found.shape == (5, 4)
        of_copies = {0, 2} if turned else {0}
        for view, others in enumerate(({3, 4}, {3, 4}, {3, 4}, of_copies | {4}, of_copies | {3})):
            assert {0 if other == 1 else other for other in found[view].tolist()} == others


@torch.no_grad()
def test_repeated_views_do_no_harm() -> None:
    """A camera that rested: the depth of its view stays as right as without the repetitions."""
    frames = SyntheticScenes(1, 1_500_001, size=(64, 128)).load("room-1500001", range(0, 16, 2))
    backend, errors = SweepBackend(), []
    for rows in ([0, 1, 2, 3], [0, 0, 0, 0, 1, 2, 3]):
        cameras = Cameras(frames.world_to_camera[None, rows], frames.intrinsics[None, rows], (64, 128))
        depth = backend.decode(backend.encode(frames.images[None, rows], Hints(cameras=cameras))).depth[0, 0]
        truth = frames.depth[0]
        errors.append(float(((depth - truth).abs() / truth)[truth > 0].median()))
    assert errors[1] < 1.3 * errors[0] + 0.01


@pytest.mark.parametrize("size", [(8, 8), (8, 32), (16, 8)])
def test_images_of_a_single_patch(make_scene, size: tuple[int, int]) -> None:
    backend = SweepBackend(pretrained=False)
    images, hints = make_scene(1, 3, size)
    depth = backend.decode(backend.encode(images, Hints(cameras=hints.cameras))).depth
    assert depth.shape == (1, 3, *size)
    assert depth.isfinite().all()


@pytest.mark.parametrize("estimated", [True, False])
def test_fused_volume_is_that_of_torch(make_scene, network: SweepNet, estimated: bool) -> None:
    views = posed(make_scene, 6)  # more than are matched at a time without gradients
    matching: Matching = network.matching[0]  # type: ignore[assignment]
    with torch.no_grad():
        matching.visible.weight.copy_(torch.tensor([[20.0, -20.0, 5.0]]))
    maps = network.features(views.images).match[0].detach()
    sources = torch.tensor([[1, 2, 3], [0, 2, 3], [1, 0, 3], [2, 1, 0], [5, 3, 2], [4, 3, 0]])
    intrinsics = resize_intrinsics(views.intrinsics, 1 / 8, 1 / 8)
    warp = SourceWarp(views.world_to_camera, intrinsics, sources, (4, 6))
    planes = Planes(baselines(views.world_to_camera))
    position = torch.linspace(0, 1, 9).view(1, -1, 1, 1).expand(6, -1, -1, -1)
    visible = None if estimated else torch.rand(6, 3, *maps.shape[-2:], generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        fused, seen = matching(maps, position, planes, warp, visible)
    slow, seen_slow = matching(maps, position, planes, warp, visible)
    torch.testing.assert_close(fused.logits, slow.logits, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(seen, seen_slow, rtol=1e-4, atol=1e-5)
    assert float(seen.std()) > 0.01


def test_shapes_and_gradients(make_scene, network: SweepNet) -> None:
    """Every parameter gets a finite gradient, also with two views."""
    views = posed(make_scene, 2)
    encoding = encode(network, views)
    depth, log_scale = network.head(
        encoding.taps, encoding.context, encoding.context_fine, encoding.swept, encoding.origin
    )
    assert depth.shape == log_scale.shape == (2, *SIZE)
    assert [stage.logits.shape[1:] for stage in encoding.stages] == [(64, 4, 6), (48, 8, 12), (8, 16, 24)]
    parts = [depth.log(), log_scale, encoding.guess, *encoding.centers, *(stage.t for stage in encoding.stages)]
    torch.stack([part.square().mean() for part in parts]).sum().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.any(), name


def test_an_orphaned_view_is_matched_with_nothing(make_scene, network: SweepNet) -> None:
    """Its logits do not depend on what the others show there; those of the other views do."""
    views = posed(make_scene)
    shown = torch.ones(4, 1, SIZE[0] // 8, SIZE[1] // 8)
    shown[0] = 0
    other = views._replace(images=torch.cat((views.images[:1], views.images[1:].flip(-1))))
    first, second = (encode(network, each, shown).stages[0].logits for each in (views, other))
    torch.testing.assert_close(first[0], second[0])
    assert (first[0] - first[0].mean()).std() < (first[1] - first[1].mean()).std()
    assert not torch.allclose(first[1], second[1], atol=1e-3)


def test_a_change_of_the_tokens_changes_depth_smoothly(make_scene) -> None:
    """The first channels of the last tap are log-depth: no change decodes the same, a small one changes it alike."""
    backend = SweepBackend(pretrained=False)
    images, hints = make_scene(2, 3, SIZE)
    tokens = backend.encode(images, Hints(cameras=hints.cameras))
    assert [tuple(tap.shape) for tap in tokens.patch] == [(2, 3, 24, 128)] * 2
    before = backend.decode(tokens)
    assert torch.equal(backend.decode(tokens).depth, before.depth)
    last = tokens.patch[-1].clone().requires_grad_()
    moved = last + torch.tensor([1.0] * 4 + [0.0] * 124)
    after = backend.decode(replace(tokens, patch=(tokens.patch[0], moved)))
    change = (after.depth / before.depth).log()
    torch.testing.assert_close(change, torch.full_like(change, RESPONSE), rtol=0, atol=2e-3)
    (gradient,) = torch.autograd.grad(after.depth.log().mean(), last)
    assert (gradient[..., :4].sum((0, 1, 2, 3)) - RESPONSE).abs() < 1e-3


def test_depth_is_in_the_unit_of_the_cameras_and_needs_no_range(make_scene) -> None:
    """Metres or millimetres give the same depth in their unit, and a range in the hints changes nothing."""
    backend = SweepBackend(pretrained=False)
    images, hints = make_scene(1, 3, SIZE)
    given = Hints(cameras=hints.cameras)
    depth = backend.decode(backend.encode(images, given)).depth
    for factor in (0.15, 0.8):
        told = replace(given, depth_range=torch.tensor([[factor, 3.0]]))
        assert torch.equal(backend.decode(backend.encode(images, told)).depth, depth)
    given.cameras.world_to_camera[..., :3, 3] *= 1000
    large = backend.decode(backend.encode(images, given)).depth
    torch.testing.assert_close(large / 1000, depth, rtol=1e-2, atol=0)
    given.cameras.world_to_camera[..., :3, 3] = 0
    with pytest.raises(ValueError, match=r"parallax, but .* all cameras are at the same position"):
        backend.encode(images, given)


def test_nothing_is_much_farther_than_what_matches(make_scene, network: SweepNet) -> None:
    """In training nothing is limited: sky must be able to become infinitely far."""
    views = posed(make_scene)
    with torch.no_grad():
        network.fill.bias.add_(torch.tensor([20.0, -20.0]))  # a guess e^20 times too far, everywhere
        limited = encode(network.eval(), views)
    assert limited.guess.min() > 10
    matched = -Planes(baselines(views.world_to_camera)).inverse(limited.stages[0].t).log()
    assert limited.centers[0].max() <= matched.max() + 0.41
    assert encode(network.train(), views).centers[0].max() > 10


def test_other_answers_are_searched_at_a_quarter(make_scene, network: SweepNet) -> None:
    """Rows of planes: around the centre, the likeliest plane that this leaves out, and the nearest depth around it."""
    views = posed(make_scene, 3)
    with torch.no_grad():
        encoding = encode(network, views)
    first, second, _ = encoding.stages
    spacing = 1 / (PLANES - 1)
    # centres of the rows, from their last planes: the first ones may be cut at infinity
    rows = second.position.unflatten(1, (3, 16))[:, :, -1] - 15 / 2 * 0.25 * spacing  # [V, 3, h, w]
    assert ((rows[:, 1] - rows[:, 0]).abs() > 2 * spacing).all()
    likely = F.interpolate(first.logits.softmax(1), size=rows.shape[-2:], mode="nearest")
    left = likely.masked_fill((first.position - rows[:, :1]).abs() <= 3 * spacing, 0)
    torch.testing.assert_close(
        rows[:, 1], (left.argmax(1) * spacing).clamp_min(0.1 * spacing), rtol=0, atol=0.05 * spacing
    )
    nearest = F.max_pool2d(rows[:, :1], 9, 1, 4)[:, 0]
    nearer = nearest - rows[:, 0] > 3 * spacing
    assert 0 < nearer.float().mean() < 1
    torch.testing.assert_close(rows[:, 2], torch.where(nearer, nearest, rows[:, 0]), rtol=0, atol=0.05 * spacing)
    mass = second.logits.softmax(1).unflatten(1, (3, 16))[:, 2].sum(1)
    assert (mass[~nearer] < 1e-6).all()  # a row that repeats the first takes nothing from it
    inside = (second.t - rows).abs().amin(1) <= 2 * spacing  # the depth is in one of the rows, not between them
    assert inside.all()
