"""Opacity compensated for the low-pass filter."""

import math
from dataclasses import replace

import pytest
import torch

from tests.rendering.scenes import assert_same_render, cameras_around, pinhole, render_with_gradients, soup
from vg2gt.rendering import render
from vg2gt.rendering.options import Mode
from vg2gt.types import Gaussians

MODES: tuple[Mode, ...] = ("solid", "rasterized")


def fine(count: int, scenes: int = 1) -> Gaussians:
    """Flat Gaussians of less than a pixel, of any orientation."""
    gaussians = soup(count, seed=4, size=0.04, scenes=scenes)
    return replace(gaussians, scales=gaussians.scales * torch.tensor([1.0, 1.0, 0.05]))


def layer(focal: float, *, antialiased: bool, mode: Mode) -> float:
    """Mean alpha of small Gaussians of sigma 1 mm, 2 mm apart, on a plane 1 m away."""
    place = torch.arange(-50, 51, dtype=torch.float64) * 0.002
    y, x = torch.meshgrid(place, place, indexing="ij")
    means = torch.stack((x.flatten(), y.flatten(), torch.ones(x.numel())), -1)
    count = len(means)
    gaussians = Gaussians(
        means=means,
        quats=torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(count, 4),
        scales=torch.tensor([1e-3, 1e-3, 1e-4], dtype=torch.float64).expand(count, 3),
        opacities=torch.full((count,), 0.545, dtype=torch.float64),
        sh=torch.zeros(count, 1, 3, dtype=torch.float64),
        batch=torch.zeros(count, dtype=torch.int64),
    )
    cameras = pinhole((20, 20), focal=(focal, focal))
    return float(render(gaussians, cameras, mode, geometry=False, antialiased=antialiased).alpha.mean())


@pytest.mark.parametrize("mode", MODES)
def test_the_alpha_of_a_fine_layer_hardly_depends_on_the_focal_length(mode: Mode) -> None:
    plain, compensated = ([layer(f, antialiased=on, mode=mode) for f in (250, 578, 1000)] for on in (False, True))
    assert plain == pytest.approx([0.997, 0.854, 0.730], abs=0.003)
    assert max(compensated) - min(compensated) < 0.05


@pytest.mark.parametrize("mode", MODES)
def test_equals_the_reference(mode: Mode) -> None:
    gaussians, cameras = fine(80, scenes=2), cameras_around((20, 24), scenes=2)
    options = {"mode": mode, "bisections": 40, "antialiased": True}
    gaussians = replace(gaussians, scales=torch.cat((gaussians.scales[::2] * 6, gaussians.scales[1::2])))
    expected, found = (
        render_with_gradients(gaussians, cameras, implementation=name, **options) for name in ("dense", "cpu")
    )
    assert_same_render(found, expected)
    plain = render(gaussians, cameras, mode, implementation="dense").alpha
    assert (plain - expected[0].alpha).mean() > 0.05


@pytest.mark.parametrize("implementation", ["dense", "cpu"])
def test_a_gaussian_keeps_its_integral_over_the_image(implementation: str) -> None:
    gaussians = replace(soup(1), means=torch.tensor([[0.0, 0, 2]]).double(), opacities=torch.tensor([0.9]).double())
    scales = torch.tensor([[0.04, 0.02, 1e-6]]).double()
    gaussians = replace(gaussians, quats=torch.tensor([[1.0, 0, 0, 0]]).double(), scales=scales)
    cameras = pinhole((24, 24), focal=(30.0, 20.0))  # sigmas of 0.6 and 0.2 px
    out = render(gaussians, cameras, implementation=implementation, geometry=False, antialiased=True)
    integral = 2 * math.pi * 0.9 * 0.6 * 0.2
    assert float(out.alpha.sum()) == pytest.approx(integral, rel=0.05)  # less what is below 1/255
    assert float(out.alpha.sum()) < integral
    plain = render(gaussians, cameras, implementation=implementation, geometry=False)
    assert float(plain.alpha.sum()) > 3 * integral


@pytest.mark.parametrize("implementation", ["dense", "cpu"])
def test_gradients_stay_bounded_where_flat_gaussians_turn_edge_on(implementation: str) -> None:
    """Nearly no thickness; from facing the camera to edge-on, where the footprint without low-pass has no area."""
    norms, alphas = [], []
    for angle in [0.0, 0.4, 0.8, 1.2, 1.5, *(math.pi / 2 - 0.1**power for power in range(2, 10)), math.pi / 2]:
        scene = soup(1)
        quats = torch.tensor([[math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0]]).double().requires_grad_()
        scales = torch.tensor([[0.2, 0.2, 1e-9]]).double().requires_grad_()
        scene = replace(scene, means=torch.tensor([[0.0, 0, 2]]).double(), quats=quats, scales=scales)
        out = render(scene, pinhole((16, 16)), "rasterized", implementation=implementation, antialiased=True)
        alphas.append(float(out.alpha.detach().sum()))
        norms.append(torch.stack([grad.norm() for grad in torch.autograd.grad(out.alpha.sum(), (quats, scales))]))
    of_quats, of_scales = torch.stack(norms).unbind(1)
    assert alphas == sorted(alphas, reverse=True)
    assert alphas[0] > 20
    assert 0.05 < alphas[5] < 0.5  # half a degree from edge-on
    assert alphas[-1] == 0
    assert of_quats[4] > 40
    assert of_quats.max() < 50
    assert of_scales.max() <= of_scales[0]
    assert not of_quats[-1]
