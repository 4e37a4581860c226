"""The plane sweep: its planes, its fused kernel against torch, the contract of its tokens."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from backends.sweep import SweepBackend
from backends.sweep.correlate import SourceWarp
from backends.sweep.network import PLANES, PosedViews, SweepEncoding, SweepNet
from backends.sweep.planes import FARTHEST, Planes, baselines, coarse_sources, fine_sources
from backends.sweep.refine import RESPONSE
from backends.sweep.stage import Matching
from vg2gt.geometry.cameras import resize_intrinsics
from vg2gt.types import Hints

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
    sources = coarse_sources(views.world_to_camera, views.intrinsics, views.size, count)
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


def test_baselines_are_in_the_unit_of_the_cameras_and_of_their_scene() -> None:
    poses = torch.eye(4).repeat(8, 1, 1)
    poses[:, 0, 3] = torch.tensor([0.0, 1, 2, 3, 0, 5, 10, 15])
    assert baselines(poses, 2).tolist() == pytest.approx([2, 1, 1, 2, 10, 5, 5, 10])
    poses[5, 0, 3] = 0  # two cameras in one place still have a baseline
    assert (baselines(poses[4:6].clone() + 0 * poses[4:6], 1) == 0).all()
    assert (baselines(poses, 2) > 0).all()


def test_sources_that_see_something_else_are_taken() -> None:
    """The second source is the one that sees what the first does not, although it sees less; none without parallax."""
    visible = torch.tensor([[0.9] * 6 + [0.1] * 4, [0.8] * 6 + [0.1] * 4, [0.1] * 7 + [0.9] * 3, [1.0] * 10])[None]
    parallax = torch.full_like(visible, 0.15)
    parallax[:, 3] = 0.001
    assert fine_sources(visible, parallax, 2).tolist() == [[0, 2]]
    assert fine_sources(visible[:, :2], parallax[:, :2], 3).shape == (1, 2)


@pytest.mark.parametrize("estimated", [True, False])
def test_fused_volume_is_that_of_torch(make_scene, network: SweepNet, estimated: bool) -> None:
    views = posed(make_scene)
    matching: Matching = network.matching[0]  # type: ignore[assignment]
    torch.nn.init.normal_(matching.visible.weight, std=5)
    maps = network.features(views.images).match[0].detach()
    sources = torch.tensor([[1, 2, 3], [0, 2, 3], [1, 0, 3], [2, 1, 0]])
    intrinsics = resize_intrinsics(views.intrinsics, 1 / 8, 1 / 8)
    warp = SourceWarp(views.world_to_camera, intrinsics, sources, (4, 6))
    planes = Planes(baselines(views.world_to_camera))
    position = torch.linspace(0, 1, 9).view(1, -1, 1, 1).expand(4, -1, -1, -1)
    visible = None if estimated else torch.rand(4, 3, *maps.shape[-2:], generator=torch.Generator().manual_seed(2))
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
    assert [stage.logits.shape[1:] for stage in encoding.stages] == [(64, 4, 6), (32, 8, 12), (8, 16, 24)]
    parts = [depth.log(), log_scale, encoding.guess, *encoding.centers, *(stage.t for stage in encoding.stages)]
    torch.stack([part.square().mean() for part in parts]).sum().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.any(), name


@torch.no_grad()
def test_scenes_are_encoded_as_if_alone(make_scene, network: SweepNet) -> None:
    alone = [posed(make_scene, 3, scene) for scene in (0, 1)]
    fields = [torch.cat([getattr(views, name) for views in alone]) for name in alone[0]._fields[:3]]
    sources = [coarse_sources(views.world_to_camera, views.intrinsics, SIZE) for views in alone]
    both = PosedViews(*fields, 2)
    found = network.encode(network.features(both.images), both, torch.cat((sources[0], sources[1] + 3)))
    expected = [encode(network, views) for views in alone]
    torch.testing.assert_close(found.swept, torch.cat([each.swept for each in expected]), rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(found.taps[-1], torch.cat([each.taps[-1] for each in expected]), rtol=1e-3, atol=1e-3)


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
    # before training nothing is added to the matched depth, which lies between those of the last stage
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
        limited = encode(network, views)
    assert limited.guess.min() > 10
    matched = -Planes(baselines(views.world_to_camera)).inverse(limited.stages[0].t).log()
    assert limited.centers[0].max() <= matched.max() + 0.41
    assert encode(network, views).centers[0].max() > 10


def test_a_second_answer_is_searched_at_a_quarter(make_scene, network: SweepNet) -> None:
    """The second row of planes lies around the likeliest plane of the first stage that the first row leaves out."""
    with torch.no_grad():
        encoding = encode(network, posed(make_scene, 3))
    first, second, _ = encoding.stages
    spacing = 1 / (PLANES - 1)
    # centres of the rows, from their last planes: the first ones may be cut at infinity
    rows = second.position.unflatten(1, (2, 16))[:, :, -1] - 15 / 2 * 0.25 * spacing  # [V, 2, h, w]
    assert ((rows[:, 1] - rows[:, 0]).abs() > 2 * spacing).all()
    likely = F.interpolate(first.logits.softmax(1), size=rows.shape[-2:], mode="nearest")
    left = likely.masked_fill((first.position - rows[:, :1]).abs() <= 3 * spacing, 0)
    torch.testing.assert_close(
        rows[:, 1], (left.argmax(1) * spacing).clamp_min(0.1 * spacing), rtol=0, atol=0.05 * spacing
    )
    inside = (second.t - rows).abs().amin(1) <= 2 * spacing  # the depth is in one of the rows, not between them
    assert inside.all()
