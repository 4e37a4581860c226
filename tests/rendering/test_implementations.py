"""Every implementation held to the dense float64 reference, in value and in gradient."""

import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from tests.rendering.scenes import (
    IMPLEMENTATIONS,
    KINDS,
    PARAMETERS,
    assert_same_render,
    cameras_around,
    floats_to,
    images,
    pinhole,
    render_with_gradients,
    soup,
    wall,
    with_gradients,
)
from vg2gt.rendering import cpu_tiles, render
from vg2gt.rendering.cpu import tiles
from vg2gt.rendering.options import DepthKind, Mode
from vg2gt.rendering.renderer import Implementation
from vg2gt.types import Gaussians

FIELDS = (*PARAMETERS, "batch")


@pytest.mark.parametrize("degree", [0, 2])
@pytest.mark.parametrize(("mode", "depth"), KINDS)
def test_equals_the_reference(mode: Mode, depth: DepthKind, degree: int) -> None:
    gaussians, cameras = soup(50, seed=degree, degree=degree, scenes=2), cameras_around((20, 24), scenes=2)
    options = {"mode": mode, "depth": depth, "bisections": 40}
    expected = render_with_gradients(gaussians, cameras, implementation="dense", **options)
    assert (expected[0].depth > 0).float().mean() > 0.2
    assert_same_render(render_with_gradients(gaussians, cameras, implementation="cpu", **options), expected)


def test_deep_translucent_rays_equal_the_reference() -> None:
    gaussians = soup(300, size=0.6)
    gaussians = replace(gaussians, opacities=gaussians.opacities * 0.05)
    expected, found = (
        render_with_gradients(gaussians, pinhole((9, 18)), implementation=name, bisections=40)
        for name in ("dense", "cpu")
    )
    assert_same_render(found, expected)


def test_tiles_with_more_hits_than_there_is_room_for_are_rendered_again(monkeypatch: pytest.MonkeyPatch) -> None:
    gaussians, cameras = soup(200, size=0.6), pinhole((20, 40))
    gaussians = replace(gaussians, opacities=gaussians.opacities * 0.1)
    expected = render(gaussians, cameras, implementation="cpu")
    given = []
    aligned = cpu_tiles._aligned
    monkeypatch.setattr(cpu_tiles, "_local", threading.local())  # no memory of other tests
    monkeypatch.setattr(cpu_tiles, "HIT_CAPACITY", 3)
    monkeypatch.setattr(cpu_tiles, "_aligned", lambda count, dtype: given.append(count) or aligned(count, dtype))
    found = render(gaussians, cameras, implementation="cpu")
    sizes = [count // (tiles.BLOCKS * tiles.HIT_SIZE) for count in given]
    assert 3 in sizes
    assert max(sizes) > 10
    for image, other in zip(images(expected), images(found), strict=True):
        assert torch.equal(image, other)


@pytest.mark.parametrize("options", [{"near": 2.6}, {"newton_steps": 0}])
def test_the_search_for_the_median_equals_the_reference(options):
    """Where Gaussians reach through the near plane, and by bisections alone."""
    gaussians, cameras = soup(80, seed=3, size=0.3), pinhole((20, 24))
    expected, found = (
        render_with_gradients(gaussians, cameras, implementation=name, bisections=45, **options)
        for name in ("dense", "cpu")
    )
    depth = expected[0].depth
    assert (depth > 0).float().mean() > 0.2
    if "near" in options:
        without = render(gaussians, cameras, implementation="dense", bisections=45, near=0.01)
        assert ((depth == 0) & (without.depth > 0)).any()
    assert_same_render(found, expected, atol=1e-10)


@pytest.mark.parametrize("opacity", [0.1, 0.3, pytest.param(0.6, marks=pytest.mark.slow)])
def test_the_compiled_search_crosses_gaps(opacity: float) -> None:
    """A translucent wall, and one forty times as far: between them nothing tells where the median is."""
    near, cameras = wall(1000, (16, 24))
    far = replace(near, means=40 * near.means, scales=near.scales * torch.tensor([40.0, 40.0, 1.0]))
    both = replace(near, **{name: torch.cat((getattr(near, name), getattr(far, name))) for name in FIELDS})
    both = replace(both, opacities=opacity * both.opacities)
    exact = render(both, cameras, implementation="dense", bisections=60).depth
    there = exact > 0
    assert there.float().mean() > 0.6
    for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 2e-6)):
        found = render(floats_to(both, dtype), floats_to(cameras, dtype), implementation="cpu").depth
        assert torch.equal(found > 0, there)
        assert ((found - exact).abs() / exact)[there].max() < tolerance


def test_float32_depth_is_that_of_float64() -> None:
    gaussians, cameras = wall(6000, (64, 96))
    exact = render(gaussians, cameras, implementation="cpu", bisections=40)
    rounded = render(floats_to(gaussians, torch.float32), floats_to(cameras, torch.float32), implementation="cpu")
    both = (exact.depth > 0) & (rounded.depth > 0)
    assert both.float().mean() > 0.95
    error = (exact.depth - rounded.depth)[both].abs()
    assert error.median() < 1e-6
    assert error.quantile(0.999) < 1e-5
    for value, reference in zip(images(rounded), images(exact), strict=True):
        assert (value - reference).abs().flatten().quantile(0.99) < 1e-4


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_cpu_is_deterministic_for_any_number_of_threads(dtype: torch.dtype) -> None:
    gaussians = floats_to(wall(3000, (40, 72))[0], dtype)
    cameras = floats_to(cameras_around((40, 72), views=3), dtype)
    threads = torch.get_num_threads()
    results = []
    try:
        for count in (1, 1, 2, 3):
            torch.set_num_threads(count)
            out, grads = render_with_gradients(gaussians, cameras, implementation="cpu")
            results.append([*images(out), *grads.values()])
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_color_only_changes_nothing_but_what_it_leaves_out(implementation: Implementation) -> None:
    gaussians, cameras = with_gradients(soup(40)), cameras_around((20, 24))
    inputs = [getattr(gaussians, name) for name in PARAMETERS]
    grads = []
    for geometry in (True, False):
        out = render(gaussians, cameras, implementation=implementation, geometry=geometry)
        grads.append(torch.autograd.grad(out.color.square().sum() + out.alpha.sum(), inputs))
    assert not out.depth.any()
    assert not out.normal.any()
    for complete, reduced in zip(*grads, strict=True):
        torch.testing.assert_close(complete, reduced, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_no_gradient_passes_the_alpha_cap(implementation: Implementation) -> None:
    gaussians = soup(1, size=3.0)
    gaussians.means[0] = torch.tensor([0.0, 0.0, 40.0])
    gaussians = with_gradients(replace(gaussians, opacities=torch.ones(1, dtype=torch.float64)))
    out = render(gaussians, pinhole((1, 1), focal=(1000.0, 1000.0)), implementation=implementation)
    assert float(out.alpha.detach()) == pytest.approx(0.99)
    grads = torch.autograd.grad(out.alpha.sum(), [gaussians.means, gaussians.opacities])
    assert not any(g.any() for g in grads)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("count", [0, 1, 3000])
def test_equal_depths_keep_their_order(dtype: type[np.floating], count: int) -> None:
    depths = np.random.default_rng(count).lognormal(1, 3, count).astype(dtype)
    depths[::3] = depths[: len(depths[::3])].round(1) + dtype(0.01)
    order = tiles.depth_order(depths)
    assert order.tolist() == sorted(range(count), key=lambda i: (depths[i], i))
    assert count < 2 or len(set(depths.tolist())) < count


def test_the_forward_pass_notes_the_blocks_that_each_gaussian_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not all of a diagonal Gaussian's box, and none behind opaque Gaussians: the backward pass visits no others."""
    noted: list[Any] = []
    prepare = cpu_tiles._prepare
    monkeypatch.setattr(cpu_tiles, "_prepare", lambda *given: noted.append(prepare(*given)) or noted[-1])
    diagonal = Gaussians(
        means=torch.tensor([[0.0, 0, 3]]),
        quats=torch.tensor([[0.924, 0, 0, 0.383]]),
        scales=torch.tensor([[0.02, 0.3, 0.02]]),
        opacities=torch.tensor([0.9]),
        sh=torch.zeros(1, 1, 3),
        batch=torch.zeros(1, dtype=torch.int64),
    )
    cameras = floats_to(pinhole((32, 32)), torch.float32)
    alpha = render(diagonal, cameras, implementation="cpu").alpha[0, 0]
    touched = alpha.view(8, 4, 8, 4).amax((1, 3)).numpy() > 0
    bits = np.zeros((8, 8), bool)
    for tile in range(4):
        for visit in noted[0].visits[noted[0].starts[tile] : noted[0].starts[tile + 1]]:
            blocks = int(visit) >> np.arange(16).reshape(4, 4) & 1
            bits[tile // 2 * 4 :, tile % 2 * 4 :][:4, :4] |= blocks > 0
    assert (bits == touched).all()
    x0, x1, y0, y1 = noted[0].boxes[0]
    assert 5 < touched.sum() < 0.7 * (-(-x1 // 4) - x0 // 4) * (-(-y1 // 4) - y0 // 4)

    wide = torch.tensor([[50.0, 50, 0.01]])
    opaque = replace(diagonal, means=diagonal.means - 1, scales=wide, opacities=torch.ones(1))
    render(opaque.joined(opaque).joined(diagonal), cameras, implementation="cpu")  # the second one stops all rays
    behind = noted[1].members == 2
    assert behind.any()
    assert noted[1].visits[~behind].all()
    assert not noted[1].visits[behind].any()
