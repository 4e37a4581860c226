"""Whole refinements: they sharpen, repeat to the bit, survive Ctrl-C and bad numbers, and never see held-out views."""

import time
from dataclasses import fields, replace
from importlib import import_module

import pytest
import torch

from tests.refinement.conftest import VIEWS, Start, run
from vg2gt.geometry.rotations import quat_to_matrix
from vg2gt.refinement import Refined, RefinedScene, RefineLoss, RefineOptions, RefineRates
from vg2gt.refinement.density import GROWTH, merged, supported, uncovered
from vg2gt.refinement.growth import contributions
from vg2gt.refinement.options import Progress
from vg2gt.types import Gaussians
from vg2gt.visibility import count_points

COLOUR = RefineLoss(depth_consistency=0, normal_render=0, normal_decoded=0)


def same(first: RefinedScene, second: RefinedScene) -> bool:
    names = [field.name for field in fields(first.gaussians) if field.name != "background"]
    pairs = [(getattr(first.gaussians, name), getattr(second.gaussians, name)) for name in names]
    pairs += [(first.cameras.world_to_camera, second.cameras.world_to_camera), (first.gain, second.gain)]
    return all(torch.equal(a, b) for a, b in pairs)


OPTIONS = RefineOptions(steps=24, check_every=8, holdout=3, rates=RefineRates(exposure=0.002))


def begun(start: Start, options: RefineOptions, steps: int = 0) -> Gaussians:
    """The Gaussians that a refinement begins with, or has after some steps."""
    parts = (start.gaussians, start.cameras, start.seen, start.renderer, options, time.monotonic)
    refinement = import_module("vg2gt.refinement.refine")._Refinement(*parts)
    for _ in range(steps):
        refinement._step()
    return refinement.parameters.scene().gaussians.detach()


@pytest.fixture(scope="module")
def refined(start: Start) -> Refined:
    return run(start, OPTIONS)


def test_held_out_views_become_sharper(refined: Refined) -> None:
    assert refined.held_out.tolist() == [2, 5]
    before, after = refined.psnr
    assert (after[refined.trained] > before[refined.trained] + 1.5).all()
    assert (after - before)[refined.held_out].mean() > 1
    assert refined.ended == "steps"


def test_the_first_camera_stays_the_others_move_and_exposures_share_nothing(refined: Refined, start: Start) -> None:
    found, before = refined.scene.cameras, start.cameras
    moved = (found.world_to_camera - before.world_to_camera).abs().amax((0, 2, 3))
    assert moved[0] == 0
    assert (moved[refined.trained[1:]] > 0).all()
    rotation = found.world_to_camera[0, :, :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).expand(VIEWS, 3, 3), atol=1e-5, rtol=0)
    gain = refined.scene.gain
    assert gain[refined.trained].log().mean(0).abs().max() < 1e-6
    assert (gain[refined.trained] != 1).any()
    assert (gain[refined.held_out] == 1).all()


def test_nothing_moves_if_all_rates_are_0(start: Start) -> None:
    rates = RefineRates(**dict.fromkeys(("means", "quats", "scales", "opacities", "sh", "cameras"), 0.0))
    kept = run(start, replace(OPTIONS, steps=4, fill=0, rates=rates))
    assert same(kept.scene, kept.start)
    assert kept.ended == "steps"


def test_it_repeats_to_the_bit_and_never_looks_at_held_out_views(refined: Refined, start: Start) -> None:
    images = start.seen.images.clone()
    images[refined.held_out] = 1 - images[refined.held_out]
    other = replace(start, seen=replace(start.seen, images=images))
    again = run(other, OPTIONS)
    assert same(again.scene, refined.scene)
    assert not torch.equal(again.psnr[1, refined.held_out], refined.psnr[1, refined.held_out])


def test_an_interruption_keeps_the_best_state(start: Start) -> None:
    def interrupt(progress: Progress) -> None:
        assert progress.share == progress.steps / 100
        assert progress.psnr > 10
        assert len(progress.scene().gaussians) > 100
        if progress.steps == 7:
            raise KeyboardInterrupt

    stopped = run(start, RefineOptions(steps=100, check_every=5, loss=COLOUR), observe=interrupt)
    assert (stopped.ended, stopped.steps, stopped.step) == ("interrupted", 7, 5)
    assert stopped.psnr[1].mean() > stopped.psnr[0].mean()


def test_geometry_counts_in_every_nth_step(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    weights, terms = [], RefineLoss.of_views
    monkeypatch.setattr(
        RefineLoss, "of_views", lambda loss, *rest: weights.append(loss.depth_consistency) or terms(loss, *rest)
    )
    begun(start, RefineOptions(steps=9, check_every=9, fill=0, geometry_every=4), 8)
    assert weights[-8:] == [8.0, 0.0, 0.0, 0.0] * 2
    assert set(weights[:-8]) == {0.0}  # scores


def test_what_only_left_out_views_show_keeps_its_opacity(start: Start) -> None:
    views = torch.arange(VIEWS)
    alone = contributions(start.gaussians, start.cameras.select(views[2:]), start.renderer) <= 1e-6
    hidden = contributions(start.gaussians, start.cameras, start.renderer) <= 1e-6
    assert (alone & ~hidden).sum() > 50
    priced = RefineOptions(steps=9, fill=0, loss=replace(COLOUR, opacity=9.0))
    parts = (start.gaussians, start.cameras, start.seen, start.renderer, priced, time.monotonic)
    left = {}
    for fold in (views[:2], views[:0]):
        refinement = import_module("vg2gt.refinement.refine")._Refinement(*parts, fold)
        for _ in range(4):
            refinement._step()
        left[len(fold)] = refinement.parameters.scene().gaussians.opacities.detach()[alone & ~hidden]
    torch.testing.assert_close(left[2], start.gaussians.opacities[alone & ~hidden], atol=1e-3, rtol=0)
    assert left[0].mean() < left[2].mean() - 0.002


@pytest.mark.parametrize("trouble", ["means", "nan"])
def test_a_divergence_ends_with_the_best_state_and_says_so(start: Start, trouble: str, caplog) -> None:
    """Rates a thousand times too large, or images that are no numbers."""
    options = RefineOptions(steps=12, check_every=3, loss=COLOUR)
    if trouble == "means":
        options = replace(options, rates=RefineRates(means=50.0))
    else:
        images = start.seen.images.clone()
        images[1] = torch.nan
        start = replace(start, seen=replace(start.seen, images=images))
    found = run(start, options)
    assert found.ended == "diverged"
    assert "the result is step" in caplog.text
    assert all(getattr(found.scene.gaussians, f.name).isfinite().all() for f in fields(found.scene.gaussians))
    if trouble == "means":
        assert found.psnr[1].mean() >= found.psnr[0].mean()


def test_what_few_views_support_is_left_out_at_the_start(start: Start) -> None:
    """A guess in the air before the cameras, which every view looks through, and one far away, which none can place."""
    depth = float(start.seen.depth.median())
    means = torch.tensor([[0.0, 0.0, 0.3 * depth], [0.0, 0.0, 50 * depth]])
    more = start.gaussians.joined(replace(start.gaussians.select(slice(2)), means=means))
    kept = supported(more, start.cameras, start.seen.depth, 2)
    assert (kept.means == means[1]).all(-1).any()
    assert not (kept.means == means[0]).all(-1).any()
    assert 0.3 * len(start.gaussians) < len(kept) < len(more)
    options = RefineOptions(steps=2, check_every=2, min_views=2, fill=0, loss=COLOUR)
    found = run(replace(start, gaussians=more), options)
    assert torch.equal(found.start.gaussians.means, more.means)
    assert len(begun(replace(start, gaussians=more), options)) == len(kept)


def test_what_two_views_support_starts_coarse(start: Start) -> None:
    """Few wide Gaussians take the place of the many that only two views agree on; the others are untouched."""
    gaussians, cameras, depth = start.gaussians, start.cameras, start.seen.depth
    strong, weak = (supported(gaussians, cameras, depth, views) for views in (3, 2))
    found = supported(gaussians, cameras, depth, 3, 8.0, start.renderer)
    assert torch.equal(found.means[: len(strong)], strong.means)
    coarse = found.select(torch.arange(len(strong), len(found)))
    assert 0 < len(coarse) < 0.5 * (len(weak) - len(strong))
    assert coarse.scales.max(-1).values.median() > 2 * strong.scales.max(-1).values.median()
    options = RefineOptions(steps=2, check_every=2, min_views=3, merge_cells=8.0, fill=0, loss=COLOUR)
    refined = run(start, options)
    assert len(begun(start, options)) == len(found)
    # two steps do not make up for the fewer Gaussians: the scene that was given comes back
    assert (refined.step, len(refined.scene.gaussians)) == (0, len(gaussians))
    assert torch.equal(refined.psnr[0], refined.psnr[1])


def test_what_a_single_view_shows_is_kept_where_nothing_else_would_be(start: Start) -> None:
    """The ground before one camera, of which no other view knows the depth."""
    depth = start.seen.depth.clone()
    depth[1:, depth.shape[1] // 2 :] = 0
    agree, _ = count_points(start.gaussians.means, depth, start.cameras, 0.03, 0.05)
    first, _ = count_points(start.gaussians.means, depth[:1], start.cameras.select(slice(0, 1)), 0.03, 0.05)
    own = (first > 0) & (agree == 1)
    parts = (start.gaussians, start.cameras, depth, 3, 8.0)
    without, found = supported(*parts), supported(*parts, start.renderer)
    holes = uncovered(without, start.cameras, depth, start.renderer)[0] > 0
    assert own.sum() > 100
    assert len(found) > len(without)
    assert len(found) - len(without) < 0.5 * own.sum()  # merged
    assert (uncovered(found, start.cameras, depth, start.renderer)[0] > 0).sum() < 0.5 * holes.sum()


def test_merged_gaussians_have_the_moments_of_their_mixture() -> None:
    """Compared with weighted moments of points drawn from the mixture; the neighbouring cell is separate."""
    generator = torch.Generator().manual_seed(0)
    means = torch.tensor([[0.2, 0.3, 0.4], [0.8, 0.6, 0.5], [1.5, 0.5, 0.5]])
    quats = torch.nn.functional.normalize(torch.randn(3, 4, generator=generator), dim=-1)
    scales = torch.tensor([[0.05, 0.1, 0.01], [0.2, 0.05, 0.02], [0.1, 0.05, 0.02]])
    opacities, sh = torch.tensor([0.3, 0.9, 0.6]), torch.eye(3)[:, None]
    found = merged(Gaussians(means, quats, scales, opacities, sh, torch.zeros(3, dtype=torch.int64)), 1.0)
    assert len(found) == 2
    noise = torch.randn(2, 200_000, 3, generator=generator) * scales[:2, None]
    points = means[:2, None] + noise @ quat_to_matrix(quats[:2]).mT
    share = opacities[:2] / opacities[:2].sum()
    mean = (share[:, None] * points.mean(1)).sum(0)
    covariance = (share[:, None, None] * ((points - mean).mT @ (points - mean))).sum(0) / noise.shape[1]
    axes = quat_to_matrix(found.quats) * found.scales[:, None] / GROWTH
    torch.testing.assert_close(found.means[0], mean, atol=1e-3, rtol=0)
    torch.testing.assert_close((axes @ axes.mT)[0], covariance, atol=1e-3, rtol=0)
    torch.testing.assert_close(found.sh[0, 0], torch.tensor([0.25, 0.75, 0.0]))
    alone = quat_to_matrix(quats[2]) * scales[2]
    torch.testing.assert_close((axes @ axes.mT)[1], alone @ alone.T)


@pytest.mark.parametrize(("last", "ended"), [(0.7, "steps"), (2.5, "diverged")])
def test_worse_than_the_best_state_is_no_divergence(start: Start, last: float, ended: str, monkeypatch) -> None:
    """A check that is worse than the best state, but better than a poor start, is no reason to fall back."""
    # of the given scene, the start, checks, and the best state or the end
    losses = iter([1.0, 1.0, 0.3, 0.3, last, 0.3, 0.3, 0.3, 0.3])

    def score(self, scene: RefinedScene, views: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        loss = torch.full((len(views),), next(losses))
        return loss, loss

    monkeypatch.setattr(import_module("vg2gt.refinement.refine")._Refinement, "_score", score)
    assert run(start, RefineOptions(steps=12, check_every=3, loss=COLOUR)).ended == ended


def test_seconds_end_it_and_without_an_end_every_view_is_rendered_twelve_times(start: Start) -> None:
    ticks = iter(range(1000))
    found = run(start, RefineOptions(steps=None, seconds=30, loss=COLOUR), clock=lambda: float(next(ticks)))
    assert (found.ended, RefineOptions().of(10).steps) == ("seconds", 120)
    assert 3 < found.steps < 30


def test_colours_may_learn_to_depend_on_the_view_and_what_lies_behind_the_scene_stays(start: Start) -> None:
    behind = torch.tensor([[0.9, 0.5, 0.1]])
    begun = replace(start, gaussians=replace(start.gaussians, background=behind))
    found = run(begun, RefineOptions(steps=3, sh_degree=1, loss=COLOUR)).scene.gaussians
    assert found.sh.shape[1] == 4
    assert found.sh[:, 1:].abs().max() > 0
    assert torch.equal(found.background, behind)  # pyright: ignore


def test_options_out_of_range(start: Start) -> None:
    with pytest.raises(ValueError, match="matching images, depth and cameras"):
        run(replace(start, cameras=start.cameras.select(slice(0, 3))), RefineOptions())
    with pytest.raises(ValueError, match="no Gaussians"):
        run(replace(start, gaussians=start.gaussians.map(lambda tensor: tensor[:0])), RefineOptions())
    with pytest.raises(ValueError, match=r"refine.steps must be at least 1, or null"):
        RefineOptions(steps=0)
    with pytest.raises(ValueError, match=r"refine.geometry_every must be 1 without a term of colour.*, got 4"):
        RefineOptions(geometry_every=4, loss=RefineLoss(color_l1=0.0, ssim=0.0))
    with pytest.raises(ValueError, match=r"refine.fill must be at least 0, got -1"):
        RefineOptions(fill=-1)
    with pytest.raises(ValueError, match=r"refine.rates.sh"):
        RefineRates(sh=-1)
    with pytest.raises(ValueError, match=r"refine.loss.ssim"):
        RefineLoss(ssim=float("nan"))
