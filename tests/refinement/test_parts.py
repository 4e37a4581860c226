"""Parameters, density, the order of views and the loss, each on its own."""

import math
from collections import Counter
from dataclasses import replace

import pytest
import torch

from tests.refinement.conftest import VIEWS, Start
from vg2gt.geometry.cameras import invert_rigid
from vg2gt.kernels.adam import RowUpdate, bias_corrections, update_rows, update_rows_reference
from vg2gt.refinement import Observations, RefinedScene, RefineLoss, RefineRates
from vg2gt.refinement.parameters import BETAS, EPSILON, LONGEST, Parameters
from vg2gt.refinement.refine import ViewOrder, split_views

PIXEL, DEPTH = 0.01, 2.0


@pytest.fixture
def parameters(start: Start) -> Parameters:
    ones = torch.ones(VIEWS, 3)
    state = RefinedScene(start.gaussians, start.cameras, ones, torch.zeros_like(ones))
    return Parameters(state, RefineRates(), PIXEL, DEPTH, torch.arange(VIEWS))


def test_parameters_begin_with_the_scene_and_cameras_move_by_pixels(parameters: Parameters, start: Start) -> None:
    """A turn about the own centre by one pixel's angle; a shift by one pixel at the median depth."""
    scene = parameters.scene()
    for name in ("means", "scales", "opacities", "sh"):
        torch.testing.assert_close(getattr(scene.gaussians, name), getattr(start.gaussians, name))
    torch.testing.assert_close(scene.cameras.world_to_camera, start.cameras.world_to_camera)
    moves = parameters.values["cameras"].detach()
    moves[1, 1], moves[2, 3] = 1.0, 1.0
    found, before = parameters.scene().detach().cameras.world_to_camera[0], start.cameras.world_to_camera[0]
    turn = found[1] @ invert_rigid(before[1])
    assert math.acos((float(turn[:3, :3].trace()) - 1) / 2) == pytest.approx(PIXEL, rel=0.01)
    torch.testing.assert_close(invert_rigid(found[1])[:3, 3], invert_rigid(before[1])[:3, 3])
    torch.testing.assert_close((found[2] - before[2])[:3, 3], torch.tensor([PIXEL * DEPTH, 0, 0]), atol=1e-6, rtol=0)


def test_another_frame_is_the_same_scene(parameters: Parameters, start: Start) -> None:
    state = parameters.scene().detach()
    colours = torch.randn(len(state.gaussians.sh), 4, 3, generator=torch.Generator().manual_seed(0))
    state = replace(state, gaussians=replace(state.gaussians, sh=colours))
    pose = start.cameras.world_to_camera[0, 3]
    moved = state.seen_from(pose)
    assert torch.equal(moved.cameras.world_to_camera[0, 0], pose)
    assert (moved.gaussians.means - state.gaussians.means).abs().max() > 0.1
    first, second = (start.renderer(s.gaussians, s.cameras.select(slice(1, 2))) for s in (state, moved))
    for name in ("color", "depth", "normal"):
        difference = (getattr(first, name) - getattr(second, name)).abs()
        assert difference.mean() < 1e-4, name


def test_steps_are_in_units_of_each_gaussian_and_finite(parameters: Parameters) -> None:
    scene = parameters.scene().gaussians
    before = scene.means.detach()
    assert not parameters.step(parameters.scene().gaussians.means.sum() * torch.nan, share=1.0)
    assert torch.equal(parameters.scene().gaussians.means, before)
    scene = parameters.scene().gaussians
    assert parameters.step((scene.means * torch.randn_like(scene.means)).sum(), share=0.5)
    moved = (parameters.scene().gaussians.means.detach() - before).abs() / parameters.unit[:, None]
    torch.testing.assert_close(moved, torch.full_like(moved, 0.5 * RefineRates().means), rtol=0.05, atol=1e-3)


def test_no_gaussian_becomes_a_stroke(parameters: Parameters) -> None:
    for _ in range(200):
        scales = parameters.scene().gaussians.scales
        parameters.step(-scales[:, 0].log().sum() + scales[:, 1:].log().sum(), share=1.0)
    scales = parameters.scene().gaussians.scales.detach()
    torch.testing.assert_close(scales.max(-1).values, LONGEST * scales.median(-1).values)


def test_what_is_transparent_is_removed_and_adam_keeps_what_it_knows_of_the_rest(parameters: Parameters) -> None:
    scene = parameters.scene().gaussians
    parameters.step(scene.means.square().sum() + scene.opacities.square().sum(), share=1.0)
    seen = parameters.moments["means"][1].clone()
    assert (seen > 0).any()
    parameters.values["opacities"].detach()[:10] = -6.0
    opacities = parameters.scene().gaussians.opacities.detach()
    parameters.prune()
    assert torch.equal(parameters.moments["means"][1], seen[10:])
    assert torch.equal(parameters.scene().gaussians.opacities, opacities[10:])
    assert parameters.step(parameters.scene().gaussians.means.sum(), share=1.0)
    parameters.values["opacities"].detach().fill_(-6.0)
    parameters.prune()
    assert len(parameters.scene().gaussians) == len(opacities) - 10


@pytest.mark.parametrize(("views", "holdout"), [(12, 4), (20, None), (2, None)])
def test_views_are_dealt_alike_and_left_out_in_turns(views: int, holdout: int | None) -> None:
    nothing = torch.empty(views, 1, 2, 2)
    trained, held_out = split_views(Observations(nothing, nothing[:, 0], nothing[:, 0]), holdout)
    assert held_out.tolist() == list(range(holdout - 1, views, holdout) if holdout else [])
    assert sorted([*trained.tolist(), *held_out.tolist()]) == list(range(views))
    order = ViewOrder(trained, seed=0)
    dealt: Counter[int] = Counter()
    left_out: Counter[int] = Counter()
    for _ in range(40):
        for _ in range(60):
            (view,) = order.deal().tolist()
            assert view not in order.left_out
            dealt[view] += 1
        left_out.update(order.left_out.tolist())
        order.next_round()
    assert set(dealt) == set(trained.tolist())
    assert max(dealt.values()) < 1.2 * min(dealt.values())
    assert set(left_out) == (set() if views < 4 else set(trained.tolist()))


def test_a_perfect_view_has_no_loss(start: Start) -> None:
    rendered = start.renderer(start.gaussians, start.cameras)
    seen = replace(start.seen, images=rendered.color[0], depth=rendered.depth[0])
    terms = RefineLoss(normal_render=0, normal_decoded=0).of_views(rendered, start.cameras, seen, 1.0)
    assert set(terms) == {"color_l1", "ssim", "depth_consistency"}
    assert all(abs(float(term)) < 1e-4 for term in terms.values())
    assert not RefineLoss().with_geometry(0).needs_geometry
    priced, opacities = RefineLoss(opacity=0.1), start.gaussians.opacities
    weights = (torch.arange(len(opacities)) % 2).to(opacities.dtype)
    terms = priced.of_gaussians(start.gaussians, weights)
    assert float(priced.total(terms)) == pytest.approx(0.1 * float((weights * opacities).mean()))
    off = replace(rendered, depth=1.1 * rendered.depth)
    moved = RefineLoss().of_views(off, start.cameras, seen, 2.0)["depth_consistency"]
    hits = (rendered.depth > 0) & (rendered.alpha > 0.5)
    trust = torch.where(hits[0], seen.depth_conf, 0)
    assert float(moved) == pytest.approx(float((0.05 * rendered.depth[0] * trust).sum() / trust.sum()), rel=1e-3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
def test_compiled_adam_is_adam(shape: tuple[int, ...], dtype: torch.dtype) -> None:
    """The kernel equals the plain update, and both equal torch's Adam where every row changes in every step."""
    torch.manual_seed(0)
    count, rate = 9000, 0.03
    value = torch.randn(count, *shape, dtype=dtype)
    leaf = value.clone().requires_grad_(True)
    adam = torch.optim.Adam([leaf], rate, BETAS, EPSILON)
    states = [(value.clone(), (torch.zeros_like(value), torch.zeros_like(value))) for _ in range(2)]
    unit = torch.ones(count, dtype=dtype)
    every = torch.randperm(count)
    for step in range(1, 4):
        grad = torch.randn_like(value)
        corrections = bias_corrections(torch.full((count,), step, dtype=dtype), BETAS)
        for update, (own, moments) in zip((update_rows, update_rows_reference), states, strict=True):
            update(RowUpdate(own, moments, grad[every], every, corrections, unit, BETAS, EPSILON, rate))
        leaf.grad = grad
        adam.step()
    torch.testing.assert_close(states[0], states[1])
    torch.testing.assert_close(states[0][0], leaf.detach())
    # some rows only, in units of their own: the others stay
    rows, unit = torch.arange(0, count, 3), torch.rand(count, dtype=dtype) + 0.5
    before, grad = states[0][0].clone(), torch.randn(len(rows), *shape, dtype=dtype)
    corrections = bias_corrections(torch.arange(len(rows), dtype=dtype) + 1, BETAS)
    for update, (own, moments) in zip((update_rows, update_rows_reference), states, strict=True):
        update(RowUpdate(own, moments, grad, rows, corrections, unit, BETAS, EPSILON, rate))
    torch.testing.assert_close(states[0], states[1])
    assert torch.equal(states[0][0][1::3], before[1::3])
    assert not torch.equal(states[0][0][::3], before[::3])
