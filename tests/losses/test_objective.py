"""The whole objective: scale, averaging over scenes, missing depth, what is trained and what is only logged."""

from dataclasses import replace

import pytest
import torch
from hydra.utils import instantiate

from vg2gt.config import compose
from vg2gt.geometry.cameras import scale_translations
from vg2gt.losses import EnhancementLoss, GaussianLoss, GeometryLoss, ScaleAlignment, VG2GTLoss
from vg2gt.losses.geometry import TaskLoss

DEPTH_TERMS = ["depth_conf", "depth_reg", "depth_grad", "point_conf", "point_reg", "point_grad"]
GAUSSIAN_TERMS = ["color_l1", "ssim", "depth_consistency", "depth_gt", "normal"]


def noisy(made, seed=0, amount=0.03):
    generator = torch.Generator().manual_seed(seed)
    geometry = made.prediction.geometry
    noise = [torch.randn(geometry.depth.shape, generator=generator).to(geometry.depth.dtype) for _ in range(2)]
    shade = torch.rand(made.rendered.color.shape, generator=generator).to(geometry.depth.dtype)
    made = made.with_depth(geometry.depth * (1 + amount * noise[0]))
    made = made.with_initial(geometry.depth * (1 + amount * noise[1]))
    return made.with_render(color=0.8 * made.rendered.color + 0.2 * shade, depth=1.01 * made.rendered.depth)


def in_unit(made, factor: float):
    """The same prediction in another unit."""
    factors = torch.full_like(made.prediction.unit, factor)

    def change(geometry):
        return replace(geometry, depth=geometry.depth * factor, cameras=scale_translations(geometry.cameras, factors))

    initial, geometry = change(made.prediction.initial), change(made.prediction.geometry)
    prediction = replace(made.prediction, initial=initial, geometry=geometry)
    made = made.with_render(depth=made.rendered.depth * factor)
    return replace(made, prediction=prediction, cameras=scale_translations(made.cameras, factors))


def test_an_exact_prediction_in_any_unit_costs_only_confidence(sample) -> None:
    report = VG2GTLoss()(*sample(unit=2.5).inputs)
    for name in set(DEPTH_TERMS + GAUSSIAN_TERMS) - {"depth_conf", "point_conf"}:
        assert float(report.terms[name]) < 1e-5, name
    assert (float(report.terms["rendered"]), report.skipped) == (1, 0)


@pytest.mark.parametrize("align", [ScaleAlignment(), ScaleAlignment("rendered")])
def test_the_predictions_unit_does_not_matter(sample, align: ScaleAlignment) -> None:
    made = noisy(sample(scenes=2))
    loss = VG2GTLoss(align=align)
    one, other = loss(*made.inputs), loss(*in_unit(made, 0.13).inputs)
    torch.testing.assert_close(other.total, one.total)
    torch.testing.assert_close(other.scale * 0.13, one.scale)
    for name, value in one.terms.items():
        torch.testing.assert_close(other.terms[name], value, msg=name)


def test_scale_source_on_gaussians_that_are_a_tenth_too_far(sample) -> None:
    made = sample(rendered=(0, 1, 2))
    made = made.with_render(depth=1.1 * made.rendered.depth)
    plain = GaussianLoss(confidence_weighted=False)
    enhanced = VG2GTLoss(gaussian=plain, align=ScaleAlignment("enhanced"))(*made.inputs)
    rendered = VG2GTLoss(gaussian=plain, align=ScaleAlignment("rendered"))(*made.inputs)
    torch.testing.assert_close(rendered.scale * 1.1, enhanced.scale)
    mean_depth = float(made.batch.depth[:, :3].mean() * enhanced.scale / 2.5)
    assert float(enhanced.terms["depth_gt"]) == pytest.approx(0.1 * mean_depth, rel=1e-6)
    assert float(enhanced.terms["depth_reg"]) < 1e-9
    assert float(rendered.terms["depth_gt"]) < 1e-9
    assert float(rendered.terms["depth_reg"]) == pytest.approx((1 - 1 / 1.1) * mean_depth, rel=1e-2)
    for report in (enhanced, rendered):
        assert float(report.terms["initial_depth"]) < 0  # the backbone's own depth has its own, exact scale
        expected = 0.1 * mean_depth * float(report.scale / enhanced.scale)
        assert float(report.terms["depth_consistency"]) == pytest.approx(expected, rel=1e-6)
    nothing = made.with_render(depth=torch.zeros_like(made.rendered.depth))  # falls back to the enhanced depth
    report = VG2GTLoss(align=ScaleAlignment("rendered"))(*nothing.inputs)
    torch.testing.assert_close(report.scale, enhanced.scale)


def test_scales_are_constants(sample) -> None:
    made = noisy(sample())
    depth = made.prediction.geometry.depth.clone().requires_grad_()
    report = VG2GTLoss()(*made.with_depth(depth).inputs)
    assert not report.scale.requires_grad
    # Were the scale part of the graph, moving along the depth itself (a change of unit) would cost nothing.
    (gradient,) = torch.autograd.grad(report.total, depth)
    assert abs(float((gradient * depth.detach()).sum())) > 1e-4


@pytest.mark.parametrize("align", [ScaleAlignment(), ScaleAlignment("rendered")])
def test_a_scene_without_depth_still_trains_its_colours(sample, align: ScaleAlignment) -> None:
    made = noisy(sample(scenes=2))
    missing = made.batch.depth.clone()
    missing[1] = 0
    missing[1, :, 0, :20] = 3  # 60 pixels in context views are not enough to know the scale
    leaves = {
        "depth": made.prediction.geometry.depth.clone(),
        "conf": made.prediction.geometry.depth_conf.clone(),
        "color": made.rendered.color.clone(),
        "rendered": made.rendered.depth.clone(),
        "normal": made.rendered.normal + 0.1,
    }
    leaves = {name: leaf.requires_grad_() for name, leaf in leaves.items()}
    made = made.with_truth(missing).with_depth(leaves["depth"], leaves["conf"])
    made = made.with_render(color=leaves["color"], depth=leaves["rendered"], normal=leaves["normal"])
    report = VG2GTLoss(align=align)(*made.inputs)
    assert (report.skipped, float(report.scale[1])) == (1, 1)
    report.total.backward()
    for name, leaf in leaves.items():
        assert leaf.grad is not None, name
        assert torch.isfinite(leaf.grad).all(), name
        assert leaf.grad[0].any(), name
        # rendered depth follows the decoded one, which nothing holds
        assert bool(leaf.grad[1].any()) is (name not in ("depth", "conf")), name


def test_the_total_is_the_weighted_sum_of_the_terms(sample) -> None:
    base = VG2GTLoss()(*noisy(sample()).inputs)
    weights = dict.fromkeys([*DEPTH_TERMS, *GAUSSIAN_TERMS], 1.0) | {"enhance_depth": 3.0, "enhance_point": 3.0}
    torch.testing.assert_close(base.total, sum(weight * base.terms[name] for name, weight in weights.items()))
    assert not any(value.requires_grad for value in base.terms.values())


def test_term_weights_reach_the_total(sample) -> None:
    made = noisy(sample())
    loss = VG2GTLoss(
        GeometryLoss(depth=2, point=0.5, gamma=1.5, alpha=0.1),
        EnhancementLoss(weight=0),
        GaussianLoss(weight=0.1, depth_consistency=0, depth_gt=0),
    )
    report = loss(*made.inputs)
    terms = report.terms
    expected = 2 * sum(terms[n] for n in DEPTH_TERMS[:3]) + 0.5 * sum(terms[n] for n in DEPTH_TERMS[3:])
    torch.testing.assert_close(report.total, expected + 0.1 * (terms["color_l1"] + terms["ssim"] + terms["normal"]))


@pytest.mark.parametrize(
    ("name", "weights"), [("paper", (1.0, 1.0, 1.0, 1.0, 1.0, 1.0)), ("release", (10.0, 0.9, 0.1, 0.25, 0.25, 0.001))]
)
def test_configurations_hold_the_published_weights(name: str, weights: tuple[float, ...]) -> None:
    loss = instantiate(compose(f"loss/{name}", "+loss.enhance.on=reg", "loss.align.source=rendered").loss)
    assert isinstance(loss, VG2GTLoss)
    g = loss.gaussian
    assert (g.weight, g.color_l1, g.ssim, g.depth_consistency, g.depth_gt, g.normal) == weights
    assert (loss.geometry, loss.enhance) == (GeometryLoss(), EnhancementLoss(weight=3, on="reg"))
    assert loss.align == ScaleAlignment("rendered")


def test_wrong_inputs_are_named(sample) -> None:
    made = sample()
    with pytest.raises(ValueError, match=r"prediction\.geometry\.depth is \(1, 3, 24, 32\).*\(1, 2, 24, 32\)"):
        VG2GTLoss()(made.prediction, replace(made.batch, num_context=2))
    with pytest.raises(ValueError, match=r"loss\.align\.source.*'scene'"):
        ScaleAlignment("scene")
    with pytest.raises(ValueError, match=r"loss\.enhance\.form.*'printed'"):
        EnhancementLoss(form="printed")
    with pytest.raises(ValueError, match=r"loss\.enhance\.on.*'conf'"):
        EnhancementLoss(on="conf")


def task(conf: float, reg: float, grad: float) -> TaskLoss:
    return TaskLoss(*(torch.tensor(x, requires_grad=True) for x in (conf, reg, grad)))


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, 0.5),
        ({"on": "reg"}, 0.0),
        ({"on": "reg", "margin": 0.3}, 0.1),
        ({"form": "paper_literal"}, 0.0),
        ({"form": "paper_literal", "on": "reg"}, 0.2),
    ],
)
def test_the_hinge_by_hand(options: dict, expected: float) -> None:
    before, after = task(1.0, 0.5, 0.2), task(1.6, 0.3, 0.3)  # totals 1.7 and 2.2
    assert float(EnhancementLoss(**options)(before, after).detach()) == pytest.approx(expected)
    EnhancementLoss()(before, after).backward()  # only the loss after enhancement is trained
    assert before.reg.grad is None
    assert after.reg.grad == 1
