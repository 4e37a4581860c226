"""Losses of rendered views, term by term."""

from dataclasses import replace

import pytest
import torch
from kornia.metrics import ssim
from torch import Tensor

from vg2gt.geometry.normals import normals_from_depth
from vg2gt.kernels.structure import WINDOW
from vg2gt.losses import GaussianLoss, VG2GTLoss
from vg2gt.losses.gaussian import RenderTargets, structure_loss, structure_reference
from vg2gt.types import Cameras, Render

SIZE = (20, 26)


@pytest.fixture
def case() -> tuple[Render, Cameras, RenderTargets, Tensor]:
    """Two rendered views of one scene with random content, and what they should show."""
    g = torch.Generator().manual_seed(5)
    rand = lambda *shape: torch.rand(*shape, generator=g, dtype=torch.float64)  # noqa: E731
    x = torch.linspace(0, 2, SIZE[1], dtype=torch.float64)
    surface = 2 + 0.2 * torch.sin(x).expand(2, *SIZE)
    depth = surface * (1 + 0.02 * rand(2, *SIZE))
    depth[rand(2, *SIZE) < 0.1] = 0
    rendered = Render(rand(1, 2, 3, *SIZE), depth[None], rand(1, 2, 3, *SIZE) - 0.7, rand(1, 2, *SIZE))
    k = torch.tensor([[25.0, 0, 12.5], [0, 25, 9.5], [0, 0, 1]], dtype=torch.float64)
    cameras = Cameras(torch.eye(4, dtype=torch.float64).expand(1, 2, 4, 4), k.expand(1, 2, 3, 3), SIZE)
    valid = torch.ones(2, *SIZE, dtype=torch.bool)
    targets = RenderTargets(
        rand(2, 3, *SIZE),
        3 * surface * (1 + 0.02 * rand(2, *SIZE)),
        rand(2, *SIZE) > 0.2,
        (k * torch.tensor([1.1, 1.1, 1], dtype=torch.float64)[:, None]).expand(2, 3, 3),
        3 * surface,
        1 + rand(2, *SIZE),
        valid.clone(),
        torch.ones(1, 1, 1, dtype=torch.bool),
    )
    return rendered, cameras, targets, torch.tensor(3.05, dtype=torch.float64)


def test_colour_and_depth_terms_by_hand(case) -> None:
    rendered, _, targets, scale = case
    terms = GaussianLoss()(*case)
    hits = (rendered.depth[0] > 0) & (rendered.alpha[0] > 0.5)
    scaled = rendered.depth[0] * scale
    torch.testing.assert_close(terms["color_l1"], (rendered.color[0] - targets.images).abs().mean())
    both = hits & targets.valid
    torch.testing.assert_close(terms["depth_gt"], (scaled - targets.depth)[both].abs().mean())
    weighted = (targets.decoded_conf * (scaled - targets.decoded).abs())[hits].sum() / targets.decoded_conf[hits].sum()
    torch.testing.assert_close(terms["depth_consistency"], weighted)
    plain = GaussianLoss(confidence_weighted=False)(*case)["depth_consistency"]
    torch.testing.assert_close(plain, (scaled - targets.decoded)[hits].abs().mean())
    depth = rendered.depth.clone()
    depth[rendered.alpha <= 0.5] = 100.0  # nearly transparent: whatever depth it has does not count
    torch.testing.assert_close(GaussianLoss()(replace(rendered, depth=depth), *case[1:]), terms)


@pytest.mark.parametrize("target", ["render", "decoded", "gt"])
def test_normals_are_compared_with_the_chosen_depth_map(case, target: str) -> None:
    rendered, cameras, targets, _ = case
    hits = (rendered.depth[0] > 0) & (rendered.alpha[0] > 0.5)
    depth, intrinsics, weights = {
        "render": (rendered.depth[0] * hits, cameras.intrinsics[0], torch.ones(2, *SIZE)),
        "decoded": (targets.decoded, cameras.intrinsics[0], targets.decoded_conf),
        "gt": (targets.depth * targets.valid, targets.intrinsics, torch.ones(2, *SIZE)),
    }[target]
    expected, valid = normals_from_depth(depth, intrinsics)
    mask = hits & valid
    assert mask.any()
    cosine = torch.cosine_similarity(rendered.normal[0], expected, dim=1)
    value = ((1 - cosine) * weights)[mask].sum() / weights[mask].sum()
    torch.testing.assert_close(GaussianLoss(normal_target=target)(*case)["normal"], value)


def test_nothing_rendered_gives_zeros_with_graph_and_finite_gradients(case) -> None:
    rendered, cameras, targets, scale = case
    depth = torch.zeros_like(rendered.depth).requires_grad_()
    normal = torch.zeros_like(rendered.normal).requires_grad_()
    loss = GaussianLoss()
    terms = loss(replace(rendered, depth=depth, normal=normal), cameras, targets, scale)
    assert all(float(terms[name].detach()) == 0 for name in ("depth_gt", "depth_consistency", "normal"))
    loss.total(terms).backward()
    assert not depth.grad.any()
    assert not normal.grad.any()


@pytest.mark.parametrize("target", ["render", "decoded", "gt"])
def test_gradients_are_finite_with_holes_and_zero_normals(case, target: str) -> None:
    rendered, cameras, targets, scale = case
    normal = rendered.normal.clone()
    normal[..., :10] = 0
    decoded = targets.decoded.clone()
    decoded[:, 4:8] = torch.inf
    leaves = {"color": rendered.color, "depth": rendered.depth, "normal": normal}
    leaves = {name: leaf.clone().requires_grad_() for name, leaf in leaves.items()}
    targets = replace(targets, decoded=decoded, decoded_valid=targets.decoded_valid & decoded.isfinite())
    loss = GaussianLoss(normal_target=target)
    loss.total(loss(replace(rendered, **leaves), cameras, targets, scale)).backward()
    for name, leaf in leaves.items():
        assert leaf.grad is not None, name
        assert torch.isfinite(leaf.grad).all(), name
        assert (leaf.grad != 0).any(), name


def test_decoded_depth_and_confidence_are_constants_of_the_gaussian_losses(sample) -> None:
    made = sample()
    depth = (1.02 * made.prediction.geometry.depth).requires_grad_()
    conf = made.prediction.geometry.depth_conf.clone().requires_grad_()
    made = made.with_depth(depth, conf).with_render(depth=(1.05 * made.rendered.depth).requires_grad_())
    everything = VG2GTLoss()(*made.inputs)
    geometry_only = VG2GTLoss()(made.prediction, made.batch)
    assert float(everything.terms["depth_consistency"]) > 0.01
    gradients = (torch.autograd.grad(report.total, (depth, conf)) for report in (everything, geometry_only))
    assert all(torch.equal(a, b) for a, b in zip(*gradients, strict=True))


def test_held_out_views_have_no_decoded_depth_to_agree_with(sample) -> None:
    made = sample(rendered=(3, 1))  # view 3 is held out, view 1 is context
    wrong, flipped = made.rendered.depth.clone(), made.rendered.normal.clone()
    wrong[:, 0] *= 1.5
    flipped[:, 0] *= -1
    terms = VG2GTLoss()(*made.with_render(depth=wrong, normal=flipped).inputs).terms
    assert float(terms["depth_consistency"]) < 1e-9
    assert float(terms["normal"]) < 1e-9
    assert float(terms["depth_gt"]) > 0.1
    only_held_out = VG2GTLoss()(*sample(rendered=(3,)).inputs).terms
    assert float(only_held_out["depth_consistency"]) == float(only_held_out["normal"]) == 0


def test_colours_that_do_not_count_change_nothing(case) -> None:
    """Issue 47, item 7: what a mask hides is neither in the error nor in the structure of its neighbours."""
    rendered, cameras, targets, scale = case
    mask = torch.ones(2, *SIZE, dtype=torch.float64)
    mask[..., :8] = 0
    masked = replace(targets, mask=mask)
    color = rendered.color.clone()
    color[..., :8] = 0.123
    other = replace(rendered, color=color.requires_grad_())
    one, same = GaussianLoss()(rendered, cameras, masked, scale), GaussianLoss()(other, cameras, masked, scale)
    for name in ("color_l1", "ssim"):
        torch.testing.assert_close(one[name], same[name], rtol=0, atol=0)
    (same["color_l1"] + same["ssim"]).backward()
    assert (color.grad[..., :8] == 0).all()
    assert (color.grad[..., 8:] != 0).any()
    assert GaussianLoss()(other, cameras, targets, scale)["color_l1"] != one["color_l1"]


def pictures(height: int, width: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    reference = torch.rand(2, 3, height, width, generator=generator)
    images = reference + 0.2 * torch.randn(reference.shape, generator=generator)
    images[0, :, : height // 2] = reference[0, :, : height // 2]
    images[1, 0], reference[1, 0] = 0.25, 0.25  # flat: no variance
    return images, reference


def test_flat_bright_areas_keep_their_digits() -> None:
    """Their variance is a small difference of large numbers; with plain sums, gradients were off by 1e-3."""
    generator = torch.Generator().manual_seed(0)
    reference = torch.ones(1, 3, 24, 40)
    images = 1 - 1e-3 * torch.rand(reference.shape, generator=generator)
    found, exact = images.clone().requires_grad_(), images.double().requires_grad_()
    gradient = torch.autograd.grad(structure_loss(found, reference), found)[0]
    expected = torch.autograd.grad(structure_reference(exact, reference.double()), exact)[0]
    assert (gradient - expected).norm() < 2e-4 * expected.norm()


@pytest.mark.parametrize("size", [(6, 6), (6, 40), (11, 17), (23, 300)])
def test_the_compiled_loss_equals_the_plain_one(size: tuple[int, int]) -> None:
    images, reference = pictures(*size)
    found, exact = images.clone().requires_grad_(), images.double().requires_grad_()
    loss, expected = structure_loss(found, reference), structure_reference(exact, reference.double())
    assert type(loss.grad_fn).__name__ == "StructureBackward"
    torch.testing.assert_close(loss.double(), expected, rtol=1e-6, atol=1e-7)
    kornias = (1 - ssim(exact, reference.double(), WINDOW)).mean()  # adds 1e-12 to a denominator of at least 9e-8
    torch.testing.assert_close(expected, kornias, rtol=0, atol=2e-5)
    gradients = [torch.autograd.grad(3 * value, x)[0] for value, x in ((loss, found), (expected, exact))]
    assert (gradients[0] - gradients[1]).abs().max() < 1e-5 * gradients[1].abs().max()
