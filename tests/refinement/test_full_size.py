"""The stage on photographs at their own size: crops, splits, growth, exposure, and when it ends."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.refinement.conftest import SIZE, VIEWS, Start
from vg2gt.data.synthetic import SyntheticScenes
from vg2gt.data.transforms import to_bytes
from vg2gt.refinement import (
    FullSizeOptions,
    Photographs,
    RefinedScene,
    RefineLoss,
    RefineOptions,
    RefineRates,
    exposure_rates,
    fold_of,
    sharpen,
)
from vg2gt.refinement import sharpen as _sharpen
from vg2gt.refinement.growth import contributions, footprints, in_front, in_front_reference, remove_idle, split_large
from vg2gt.refinement.parameters import Parameters
from vg2gt.refinement.photographs import Crop, CropOrder
from vg2gt.rendering import Renderer
from vg2gt.types import Cameras

FACTOR = 3
FULL = (FACTOR * SIZE[0], FACTOR * SIZE[1])
NEAR = 0.01


@pytest.fixture(scope="module")
def photographs() -> Photographs:
    """The same room at three times the size."""
    source = SyntheticScenes(1, num_frames=VIEWS, size=FULL)
    frames = source.load(source.scenes[0], range(VIEWS))
    return Photographs(to_bytes(frames.images), frames.intrinsics)


@pytest.fixture
def begin(start: Start) -> RefinedScene:
    ones = torch.ones(VIEWS, 3)
    return RefinedScene(start.gaussians, start.cameras, ones, torch.zeros_like(ones))


def parameters_of(begin: RefinedScene) -> Parameters:
    return Parameters(begin, RefineRates(), 0.01, 2.0, torch.arange(VIEWS))


def test_a_crop_is_rendered_as_the_same_part_of_the_whole_from_the_gaussians_in_front(
    start: Start, photographs: Photographs
) -> None:
    cameras = photographs.cameras(start.cameras)
    whole = start.renderer(start.gaussians, cameras).color[0, 2]
    crop = Crop(2, 40, 100, (64, 48))
    rows = in_front(start.gaussians.scales.log(), start.gaussians.means, crop.camera(cameras), NEAR)
    assert len(rows) < 0.7 * len(start.gaussians)
    part = start.renderer(start.gaussians.select(rows), crop.camera(cameras)).color[0, 0]
    torch.testing.assert_close(part, whole[:, 40:104, 100:148], atol=1e-5, rtol=0)


def test_what_may_be_visible_is_found_as_the_reference_finds_it() -> None:
    generator = torch.Generator().manual_seed(0)
    means = 2 * torch.randn(5000, 3, generator=generator)  # half of them behind the camera
    scales = torch.randn(5000, 3, generator=generator) - 4
    intrinsics = torch.tensor([[300.0, 0, 20], [0, 310, 170], [0, 0, 1]])
    camera = Cameras(torch.eye(4)[None, None], intrinsics[None, None], (120, 160))
    found = in_front(scales, means, camera, NEAR)
    assert 100 < len(found) < 2500
    assert torch.equal(found, in_front_reference(scales, means, camera, NEAR))
    assert torch.equal(found, in_front(scales.double(), means.double(), camera.map(torch.Tensor.double), NEAR))


def test_a_crop_knows_its_pixels_and_the_depth_of_the_nearest_pixel_of_its_view(
    start: Start, photographs: Photographs
) -> None:
    crop = Crop(1, 9, 60, (30, 45))
    found = crop.observations(photographs, start.seen, start.cameras.intrinsics[0])
    assert torch.equal(found.images[0], photographs.images[1, :, 9:39, 60:105] / 255)
    assert torch.equal(found.depth[0, 1::3, 1::3], start.seen.depth[1, 3:13, 20:35])
    beyond = Crop(0, 0, 0, FULL).observations(photographs, start.seen, 2 * start.cameras.intrinsics[0])
    assert (beyond.depth[0, -1] == 0).all()


def test_half_the_size_shows_the_same(start: Start, photographs: Photographs) -> None:
    half = photographs.halved()
    assert half.size == (FULL[0] // 2, FULL[1] // 2)
    means = start.gaussians.means
    cameras = photographs.cameras(start.cameras), half.cameras(start.cameras)
    large, small = (footprints(means, each, NEAR) for each in cameras)
    assert ((small - large / 2).abs() <= 1e-4 * large).float().mean() > 0.98  # the margin cuts a pixel earlier
    expected = photographs.images.float().unflatten(-1, (-1, 2)).unflatten(-3, (-1, 2)).mean((-1, -3))
    assert (half.images - expected).abs().max() <= 0.51


def test_crops_reach_every_pixel_of_every_view() -> None:
    blank = Photographs(torch.zeros(5, 3, 90, 40, dtype=torch.uint8), torch.eye(3).expand(5, 3, 3))
    order = CropOrder(blank, 48, torch.tensor([1, 4]), seed=0)
    shown = torch.zeros(5, 90, 40)
    for _ in range(200):
        crop = order.deal()
        assert crop.size == (48, 40)
        shown[crop.view, crop.top : crop.top + 48, crop.left : crop.left + 40] += 1
    assert (shown[[0, 2, 3]] == 0).all()
    assert shown[[1, 4]].min() > 0.15 * shown[[1, 4]].max()


def test_contributions_add_up_to_what_is_covered(start: Start) -> None:
    one = start.cameras.select(slice(0, 1))
    weights = contributions(start.gaussians, one, start.renderer)
    covered = start.renderer(start.gaussians, one).alpha.sum()
    torch.testing.assert_close(weights.sum(), covered, rtol=1e-4, atol=0)


def test_the_idle_go_and_the_unseen_stay(begin: RefinedScene, start: Start) -> None:
    parameters = parameters_of(begin)
    parameters.values["means"][50:60, :] = parameters.values["means"].mean(0) + 1000
    weights = contributions(parameters.scene().gaussians, start.cameras, start.renderer)
    least = float(weights[weights > 1e-6].median())
    remove_idle(parameters, start.cameras, start.renderer, least)
    left = parameters.scene().gaussians.means.detach()
    assert len(left) == int(((weights >= least) | (weights <= 1e-6)).sum()) < 0.9 * len(weights)
    assert (left > 500).all(-1).sum() == 10


def test_halves_look_like_the_whole(begin: RefinedScene, start: Start) -> None:
    parameters = parameters_of(begin)
    shown = start.renderer(parameters.scene().gaussians.detach(), start.cameras).color
    parameters.moments["means"][1].fill_(4.0)
    pixels = 1.5
    size = begin.gaussians.scales.max(-1).values * footprints(begin.gaussians.means, start.cameras, NEAR)
    count = split_large(parameters, start.cameras, NEAR, pixels, 10**9)
    assert count == int((size > pixels).sum()) > 100
    assert len(parameters) == len(begin.gaussians) + count
    again = start.renderer(parameters.scene().gaussians.detach(), start.cameras).color
    assert (again - shown).abs().mean() < 0.012
    split = (size > pixels).nonzero()[:, 0]
    ratio = parameters.unit[split] / begin.gaussians.scales.median(-1).values[split]
    torch.testing.assert_close(parameters.moments["means"][1][split, 0], 4 * ratio.square())
    middle = (parameters.values["means"][split] + parameters.values["means"][-count:]) / 2
    torch.testing.assert_close(middle, begin.gaussians.means[split], atol=1e-5, rtol=0)


def test_no_more_than_allowed_are_split_and_the_largest_first(begin: RefinedScene, start: Start) -> None:
    parameters = parameters_of(begin)
    size = begin.gaussians.scales.max(-1).values * footprints(begin.gaussians.means, start.cameras, NEAR)
    assert split_large(parameters, start.cameras, NEAR, 0.5, len(begin.gaussians) + 10) == 10
    changed = (parameters.values["scales"][: len(size)] != begin.gaussians.scales.log()).any(-1)
    assert torch.equal(changed.nonzero()[:, 0], size.topk(10).indices.sort().values)


def test_detail_appears_that_the_working_size_does_not_show(
    begin: RefinedScene, start: Start, photographs: Photographs
) -> None:
    options = RefineOptions(full=FullSizeOptions(steps=40, crop=64, grow_every=15, max_gaussians=60_000), sh_degree=0)
    found = sharpen(begin, photographs, start.seen, start.renderer, options)
    assert (found.ended, found.steps, len(found.fold)) == ("steps", 40, 1)
    assert len(found.scene.gaussians) > len(begin.gaussians)
    assert len(found.scores) > 1  # of the view that was left out

    def psnr(scene: RefinedScene, renderer: Renderer, truth: Photographs) -> float:
        shown = renderer(scene.gaussians, truth.cameras(scene.cameras)).color[0]
        return float(-10 * (shown - truth.images / 255).square().mean().log10())

    assert psnr(found.scene, found.renderer, photographs) > psnr(begin, start.renderer, photographs) + 1.0
    small = photographs.halved().halved()  # right there only with compensated opacities
    assert psnr(found.scene, found.renderer, small) > psnr(found.scene, start.renderer, small) + 1.0
    again = sharpen(begin, photographs, start.seen, start.renderer, options)
    assert torch.equal(again.scene.gaussians.means, found.scene.gaussians.means)


def test_no_gaussian_becomes_thinner_than_the_pixels_show(
    begin: RefinedScene, start: Start, photographs: Photographs
) -> None:
    cameras = photographs.cameras(start.cameras)

    def thin(thinnest: float) -> float:  # share of the Gaussians that are thinner than half a pixel
        full = FullSizeOptions(steps=12, crop=400, grow_until=0.0, coarse=0.0, least=0.0, fold=0, thinnest=thinnest)
        options = RefineOptions(full=full, sh_degree=0)
        found = sharpen(begin, photographs, start.seen, start.renderer, options).scene.gaussians
        pixels = footprints(found.means, cameras, NEAR)
        return float((found.scales.min(-1).values * pixels)[pixels > 0].lt(0.5).float().mean())

    assert thin(0.0) > 0.2
    assert thin(0.55) < 0.02


def test_structure_counts_by_a_factor(begin: RefinedScene, start: Start, photographs: Photographs) -> None:
    def colors(factor: float, weight: float) -> Tensor:
        full = FullSizeOptions(steps=3, crop=64, grow_until=0.0, coarse=0.0, least=0.0, fold=0, ssim=factor)
        options = RefineOptions(full=full, loss=RefineLoss(ssim=weight), sh_degree=0)
        return sharpen(begin, photographs, start.seen, start.renderer, options).scene.gaussians.sh

    assert torch.equal(colors(2.0, 0.2), colors(1.0, 0.4))
    assert not torch.equal(colors(2.0, 0.2), colors(1.0, 0.2))


@pytest.mark.parametrize(
    ("course", "ended"),
    [
        ([20, 22, 23, 21, 21, 21, 21], "overfitting"),
        ([20, 18, 18, 18], "no gain"),
        ([20, 19.2, 19.2, 19.2], "overfitting"),
        ([20, 22, 21.5, 21.6, 21.5], "steps"),
    ],
)
def test_left_out_views_decide_when_it_ends(
    begin: RefinedScene, start: Start, photographs: Photographs, monkeypatch, course, ended
) -> None:
    scores = iter([*course, *[course[-1]] * 100])
    stage = _sharpen.__globals__["_Sharpening"]
    monkeypatch.setitem(_sharpen.__globals__, "APART", 2)
    monkeypatch.setattr(stage, "_score", lambda _: float(next(scores)))
    full = FullSizeOptions(steps=40, crop=16, grow_until=0.0, coarse=0.0)
    found = sharpen(begin, photographs, start.seen, start.renderer, RefineOptions(full=full, sh_degree=0))
    assert found.ended == ended
    assert (found.steps < 34) == (ended != "steps")
    if ended == "no gain":
        assert torch.equal(found.scene.gaussians.means, begin.gaussians.means)


def test_few_views_and_few_renderings_limit_it(begin: RefinedScene, start: Start, photographs: Photographs) -> None:
    assert len(fold_of(torch.arange(5), FullSizeOptions())) == 0
    assert fold_of(torch.arange(0, 80, 2), FullSizeOptions()).tolist() == [20, 60]
    full = FullSizeOptions(steps=1000, renderings=1.5, crop=200, fold=0)
    found = sharpen(begin, photographs, start.seen, start.renderer, RefineOptions(full=full, sh_degree=0))
    assert found.steps == -(-3 * VIEWS * FULL[1] // (2 * 200))  # ceil(1.5 V / share)


def test_exposures_are_fitted_only_where_views_differ(start: Start) -> None:
    rates = RefineRates(exposure=None)
    same = exposure_rates(rates, start.gaussians, start.cameras, start.seen, start.renderer)
    assert same.exposure == 0
    gains = torch.tensor([0.6, 1.3, 0.8, 1.0, 0.7, 1.2])[:, None, None, None]
    seen = replace(start.seen, images=(start.seen.images * gains).clamp(0, 1))
    assert exposure_rates(rates, start.gaussians, start.cameras, seen, start.renderer).exposure == 0.004
    assert exposure_rates(RefineRates(), start.gaussians, start.cameras, seen, start.renderer).exposure == 0


@pytest.mark.parametrize(("name", "value"), [("crop", 8), ("coarse", 1.0), ("fold", 1), ("renderings", 0)])
def test_options_out_of_range_are_named(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"refine.full.{name} must be"):
        FullSizeOptions(**{name: value})
