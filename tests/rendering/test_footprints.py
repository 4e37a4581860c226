"""Positions and radii of Gaussians on the images, and the gradients there."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.rendering.scenes import (
    BACKGROUND,
    IMPLEMENTATIONS,
    KINDS,
    cameras_around,
    images,
    pinhole,
    random_like,
    soup,
    with_gradients,
)
from vg2gt.rendering import projection, render
from vg2gt.rendering.options import DepthKind, Mode, RenderOptions
from vg2gt.rendering.renderer import Implementation
from vg2gt.rendering.scenes import SceneViews
from vg2gt.types import Cameras, Footprints, Gaussians, Render


def weighted(out: Render) -> Tensor:
    """A scalar that every pixel of every image contributes to."""
    weights = random_like(out)
    return torch.stack(
        [(image * weight.to(image)).sum() for image, weight in zip(images(out), weights, strict=True)]
    ).sum()


def footprints_of(gaussians: Gaussians, cameras: Cameras, device: str = "cpu", **options: Any) -> dict[str, Tensor]:
    """Positions, radii, gradients and absolute gradients of two backward passes of one render, on the CPU."""
    gaussians, cameras = with_gradients(gaussians.to(device)), cameras.to(device)
    found = render(gaussians, cameras, background=BACKGROUND, absgrad=True, **options)
    assert found.footprints is not None
    loss = weighted(found)
    loss.backward(retain_graph=True)
    loss.backward()
    marks = found.footprints
    assert marks.means2d.grad is not None
    assert marks.absgrad is not None
    values = {"means2d": marks.means2d, "radii": marks.radii, "grad": marks.means2d.grad, "absgrad": marks.absgrad}
    return {name: value.detach().cpu() for name, value in values.items()}


def assert_same_footprints(found: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    """Equal to 1e-10 of the largest; some Gaussian is visible and another is not."""
    assert set((expected["radii"] > 0).unique().tolist()) == {False, True}
    for name, value in expected.items():
        assert value.any(), name
        torch.testing.assert_close(found[name], value, rtol=0, atol=1e-10 * float(value.abs().max()), msg=name)


def some_hidden(scenes: int, count: int, size: tuple[int, int] = (9, 11)) -> tuple[Gaussians, Cameras]:
    """A soup in two views, and in the first scene two Gaussians behind the cameras."""
    gaussians = soup(count, size=0.25, scenes=scenes)
    means = gaussians.means.clone()
    means[:2, 2] *= -1
    return replace(gaussians, means=means), cameras_around(size, scenes=scenes)


@pytest.mark.parametrize(("mode", "depth"), KINDS)
def test_the_references_gradient_is_that_of_moved_splats(mode: Mode, depth: DepthKind, monkeypatch) -> None:
    """Central differences: only a Gaussian's centre on the image moves."""
    gaussians, cameras, step = soup(6, seed=5, size=0.4), pinhole((5, 6), focal=(8.0, 7.0)), 1e-6
    options = {"implementation": "dense", "depth": depth, "bisections": 60, "slope_floor": 0.0, "near": 0.001}
    out = render(with_gradients(gaussians), cameras, mode, footprints=True, **options)
    weighted(out).backward()
    assert out.footprints is not None
    expected, moved = torch.zeros(6, 2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    project, depth_of = projection.project, 0.0

    def shifted(scene: SceneViews, options: RenderOptions) -> projection.Splats:
        splats = project(scene, options)
        return replace(splats, center=splats.center + moved * ((splats.depth - depth_of).abs() < 1e-9)[:, None])

    monkeypatch.setattr(projection, "project", shifted)
    for index, axis in ((i, j) for i in range(6) for j in range(2)):
        depth_of, sides = float(gaussians.means[index, 2]), []
        for sign in (1, -1):
            moved = sign * step * torch.eye(2, dtype=torch.float64)[axis]
            sides.append(weighted(render(gaussians, cameras, mode, **options)))
        expected[index, axis] = (sides[0] - sides[1]) / (2 * step)
    grad = out.footprints.means2d.grad
    assert grad is not None
    assert expected.abs().amax() > 0.1
    torch.testing.assert_close(grad[0], expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("mode", ["solid", "rasterized"])
def test_the_references_absolute_gradient_sums_over_pixels(mode: Mode) -> None:
    """One backward pass for every pixel."""
    gaussians, cameras = with_gradients(soup(6, seed=5, size=0.4)), pinhole((5, 6), focal=(8.0, 7.0))
    out = render(gaussians, cameras, mode, BACKGROUND, implementation="dense", footprints=True)
    assert out.footprints is not None
    assert out.footprints.absgrad is None
    weights, expected = random_like(out), torch.zeros_like(out.footprints.means2d)
    for y, x in ((y, x) for y in range(5) for x in range(6)):
        pixel = sum((i[..., y, x] * w[..., y, x]).sum() for i, w in zip(images(out), weights, strict=True))
        expected += torch.autograd.grad(pixel, out.footprints.means2d, retain_graph=True)[0].abs()
    found = footprints_of(gaussians, cameras, mode=mode, implementation="dense")["absgrad"] / 2
    torch.testing.assert_close(found, expected.detach(), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("mode", "depth"), [KINDS[0], pytest.param(*KINDS[1], marks=pytest.mark.slow), KINDS[2]])
def test_the_compiled_renderer_equals_the_reference(mode: Mode, depth: DepthKind) -> None:
    gaussians, cameras = some_hidden(2, 30)
    options = {"mode": mode, "depth": depth, "bisections": 40}
    expected = footprints_of(gaussians, cameras, implementation="dense", **options)
    assert (expected["absgrad"] > 1.01 * expected["grad"].abs()).any()
    assert_same_footprints(footprints_of(gaussians, cameras, implementation="cpu", **options), expected)


@pytest.mark.parametrize("options", [{"geometry": False}, {"antialiased": True, "mode": "rasterized"}])
def test_the_compiled_renderer_equals_the_reference_without_geometry_and_antialiased(options: dict[str, Any]) -> None:
    gaussians, cameras = some_hidden(1, 20)
    expected = footprints_of(gaussians, cameras, implementation="dense", **options)
    assert_same_footprints(footprints_of(gaussians, cameras, implementation="cpu", **options), expected)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_footprints_are_there_on_request_and_change_nothing_else(implementation: Implementation) -> None:
    gaussians, cameras = some_hidden(1, 20)
    plain = with_gradients(gaussians)
    out = render(plain, cameras, implementation=implementation)
    assert out.footprints is None
    weighted(out).backward()
    asked = with_gradients(gaussians)
    found = render(asked, cameras, implementation=implementation, absgrad=True)
    weighted(found).backward()
    assert all(torch.equal(a, b) for a, b in zip(images(out), images(found), strict=True))
    assert plain.means.grad is not None
    torch.testing.assert_close(asked.means.grad, plain.means.grad, rtol=1e-12, atol=1e-12)
    with torch.no_grad():
        still = render(gaussians, cameras, implementation=implementation, footprints=True).footprints
    assert isinstance(still, Footprints)
    assert found.footprints is not None
    assert not still.means2d.requires_grad
    assert torch.equal(still.radii, found.footprints.radii)


def test_a_radius_covers_what_is_seen_and_hardly_more() -> None:
    gaussians, cameras = soup(1, size=0.3), pinhole((101, 101))
    gaussians = replace(gaussians, means=torch.tensor([[0.0, 0.0, 3.0]], dtype=torch.float64))
    out = render(gaussians, cameras, footprints=True)
    assert out.footprints is not None
    rows, columns = torch.nonzero(out.alpha[0, 0] >= 1 / 255).unbind(-1)
    half = max(float(rows.max() - rows.min()), float(columns.max() - columns.min())) / 2
    assert half <= float(out.footprints.radii) < half + 1
    assert half > 5
    assert out.footprints.means2d[0, 0].tolist() == [50.5, 50.5]


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("count", [0, 3])
def test_nothing_is_seen(implementation: Implementation, count: int) -> None:
    gaussians = soup(count)
    hidden = with_gradients(replace(gaussians, means=-gaussians.means))
    out = render(hidden, pinhole((5, 9)), implementation=implementation, absgrad=True)
    out.color.sum().backward()
    marks = out.footprints
    assert marks is not None
    assert marks.means2d.grad is not None
    assert marks.absgrad is not None
    assert not any(value.any() for value in (marks.means2d, marks.radii, marks.means2d.grad, marks.absgrad))
