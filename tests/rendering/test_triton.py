"""The Triton kernels against the dense reference: tiny scenes in the interpreter, full size on a GPU."""

import importlib.util
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.rendering.scenes import (
    BACKGROUND,
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
from tests.rendering.test_footprints import assert_same_footprints, footprints_of, some_hidden
from vg2gt.rendering import render
from vg2gt.rendering.options import DepthKind, Mode

if importlib.util.find_spec("triton") is None:
    pytest.skip("needs triton, which has wheels for Linux on x86-64 only", allow_module_level=True)
FIELDS = (*PARAMETERS, "batch")
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
runnable = pytest.mark.skipif(DEVICE == "cpu" and not INTERPRETED, reason="runs in test_in_the_interpreter's process")
if DEVICE == "cuda":
    runnable = pytest.mark.gpu


@pytest.mark.skipif(DEVICE == "cuda" or INTERPRETED, reason="only where the kernels cannot run themselves")
@pytest.mark.parametrize("chosen", ["not slow and not gpu", pytest.param("slow and not gpu", marks=pytest.mark.slow)])
def test_in_the_interpreter(chosen: str) -> None:
    """Runs three files once more, because Triton must be told of its interpreter before it is first imported."""
    environment = {**os.environ, "TRITON_INTERPRET": "1"}
    paths = [str(Path(__file__).parent / file) for file in ("test_triton.py", "test_selfcheck.py", "../test_device.py")]
    command = [sys.executable, "-m", "pytest", "-n", "0", "-m", chosen, *paths]
    result = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout[-5000:]


@runnable
@pytest.mark.parametrize(
    ("kind", "degree", "scenes", "views"),
    [
        (KINDS[0], 1, 2, 1),
        (KINDS[1], 3, 1, 2),
        (KINDS[2], 0, 1, 1),
        *(pytest.param(*case, 2, 2, marks=pytest.mark.slow) for case in zip(KINDS, (1, 3, 0), strict=True)),
        pytest.param(KINDS[0], 2, 2, 2, marks=pytest.mark.slow),
    ],
)
def test_equals_the_reference(kind: tuple[Mode, DepthKind], degree: int, scenes: int, views: int) -> None:
    """Images of 9 x 11 pixels, all scenes and views in one sequence of launches."""
    gaussians = soup(7, seed=degree, size=0.25, degree=degree, scenes=scenes)
    cameras = cameras_around((9, 11), scenes=scenes, views=views)
    options = {"mode": kind[0], "depth": kind[1], "bisections": 40}  # the reference's default leaves 1e-11
    expected = render_with_gradients(gaussians, cameras, implementation="dense", **options)
    found = render_with_gradients(gaussians, cameras, DEVICE, implementation="triton", **options)
    assert_same_render(found, expected)


@runnable
@pytest.mark.parametrize("mode", ["rasterized", pytest.param("solid", marks=pytest.mark.slow)])
def test_antialiased_equals_the_reference(mode: Mode) -> None:
    gaussians, cameras = soup(10, size=0.06), pinhole((9, 11))
    scales = gaussians.scales * torch.tensor([1.0, 1.0, 0.05])  # flat; half of them are less than a pixel wide
    gaussians = replace(gaussians, scales=torch.cat((scales[:5], 8 * scales[5:])))
    options = {"mode": mode, "bisections": 40, "antialiased": True}
    expected = render_with_gradients(gaussians, cameras, implementation="dense", **options)
    assert_same_render(render_with_gradients(gaussians, cameras, DEVICE, implementation="triton", **options), expected)


@runnable
@pytest.mark.parametrize("kind", [KINDS[1], *(pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS[::2])])
def test_footprints_equal_the_reference(kind: tuple[Mode, DepthKind], monkeypatch: pytest.MonkeyPatch) -> None:
    """Views rendered one by one, with gradient rows of one view at once."""
    from vg2gt.rendering import gpu_tiles

    gaussians, cameras = some_hidden(2, 4, (4, 9))
    held = {gpu_tiles.ROWS: 5, gpu_tiles.SLOTS: len(gaussians)}
    monkeypatch.setattr(gpu_tiles, "_at_once", lambda device, otherwise, each: held[otherwise])
    options = {"mode": kind[0], "depth": kind[1], "bisections": 40}
    expected = footprints_of(gaussians, cameras, implementation="dense", **options)
    assert_same_footprints(footprints_of(gaussians, cameras, DEVICE, implementation="triton", **options), expected)


@runnable
def test_color_only_and_rays_with_many_hits() -> None:
    gaussians, cameras = soup(36, size=0.6), pinhole((3, 4))
    gaussians = replace(gaussians, opacities=gaussians.opacities * 0.2)
    expected = render_with_gradients(gaussians, cameras, implementation="dense", bisections=40)
    out, grads = render_with_gradients(gaussians, cameras, DEVICE, implementation="triton", bisections=40)
    assert_same_render((out, grads), expected, atol=1e-11)
    leaves = with_gradients(gaussians.to(DEVICE))
    color = render(leaves, cameras.to(DEVICE), "solid", BACKGROUND, implementation="triton", geometry=False)
    torch.testing.assert_close(color.color.detach().cpu(), out.color.detach(), rtol=0, atol=1e-12)
    assert not color.depth.any()
    assert not color.normal.any()
    (grad,) = torch.autograd.grad(color.color.sum(), leaves.sh)
    assert grad.any()


@runnable
@pytest.mark.parametrize(("options", "count", "size"), [({"near": 2.6}, 20, 0.3), ({"newton_steps": 0}, 10, 0.4)])
def test_the_search_for_the_median_equals_the_reference(options: dict[str, float], count: int, size: float) -> None:
    """Where Gaussians reach through the near plane, and by bisections alone."""
    gaussians, cameras = soup(count, seed=3, size=size), pinhole((5, 6))
    expected, found = (
        render_with_gradients(gaussians, cameras, device, implementation=name, bisections=45, **options)
        for name, device in (("dense", "cpu"), ("triton", DEVICE))
    )
    depth = expected[0].depth
    assert (depth > 0).float().mean() > 0.2
    if "near" in options:
        without = render(gaussians, cameras, implementation="dense", bisections=45)
        assert ((depth == 0) & (without.depth > 0)).any()
    assert_same_render(found, expected, atol=1e-10)


@runnable
@pytest.mark.parametrize(
    ("dtype", "tolerance"), [(torch.float64, 1e-12), pytest.param(torch.float32, 2e-6, marks=pytest.mark.slow)]
)
def test_the_search_crosses_gaps(dtype: torch.dtype, tolerance: float) -> None:
    """Translucent Gaussians, and others forty times as far: between them nothing tells where the median is."""
    near, cameras = soup(12, seed=5, size=0.5), pinhole((5, 6))
    far = replace(near, means=40 * near.means, scales=near.scales * torch.tensor([40.0, 40.0, 1.0]))
    both = replace(near, **{name: torch.cat((getattr(near, name), getattr(far, name))) for name in FIELDS})
    both = replace(both, opacities=0.3 * both.opacities)
    exact = render(both, cameras, implementation="dense", bisections=60).depth
    on_device = floats_to(both, dtype).to(DEVICE), floats_to(cameras, dtype).to(DEVICE)
    found = render(*on_device, implementation="triton").depth.cpu()
    there = exact > 0
    assert (exact > 20).double().mean() > 0.3
    assert torch.equal(found > 0, there)
    assert ((found - exact).abs() / exact)[there].max() < tolerance


@runnable
def test_gradients_are_the_same_however_many_views_are_held_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    from vg2gt.rendering import gpu_tiles

    assert gpu_tiles._chunks([4, 4, 9, 10], gpu_tiles.ROWS) == ((0, 4, 0, 10),)
    gaussians, cameras = soup(7, size=0.25), cameras_around((5, 11), views=3)
    options = {"mode": "rasterized", "implementation": "triton"}
    _, expected = render_with_gradients(gaussians, cameras, DEVICE, **options)
    assert gpu_tiles._chunks([4, 4, 9, 10], 5) == ((0, 2, 0, 4), (2, 1, 4, 9), (3, 1, 9, 10))
    assert gpu_tiles._chunks([9, 18], 5) == ((0, 1, 0, 9), (1, 1, 9, 18))
    held = {gpu_tiles.ROWS: 5, gpu_tiles.SLOTS: 2 * len(gaussians)}  # two views, then one
    monkeypatch.setattr(gpu_tiles, "_at_once", lambda device, otherwise, each: held[otherwise])
    _, grads = render_with_gradients(gaussians, cameras, DEVICE, **options)
    for name, grad in expected.items():
        torch.testing.assert_close(grads[name], grad, rtol=1e-12, atol=1e-12)  # summed in another order


@runnable
@pytest.mark.parametrize(
    ("name", "value"),
    [("means", float("nan")), ("quats", 0.0), ("scales", 0.0), ("opacities", 1.5), ("sh", float("inf")), ("batch", 1)],
)
def test_bad_values_are_refused_by_name_though_the_host_looks_at_none(name: str, value: float) -> None:
    gaussians = soup(5, degree=1)
    getattr(gaussians, name)[3] = value
    with pytest.raises(ValueError, match=rf"^{name} "):
        render(gaussians.to(DEVICE), pinhole((4, 4)).to(DEVICE), implementation="triton")


@runnable
def test_nothing_to_see() -> None:
    for scene in (soup(0), replace(soup(3), means=-soup(3).means)):
        leaves = with_gradients(scene.to(DEVICE))
        out = render(leaves, pinhole((5, 9)).to(DEVICE), implementation="triton")
        assert not out.alpha.any()
        assert not out.depth.any()
        out.color.sum().backward()


@pytest.mark.gpu
@pytest.mark.parametrize(("mode", "depth"), KINDS)
def test_full_size_on_the_gpu_equals_the_cpu(mode: Mode, depth: DepthKind) -> None:
    gaussians, cameras = (floats_to(value, torch.float32) for value in wall(50_000, (224, 448)))
    options = {"mode": mode, "depth": depth}
    expected, expected_grads = render_with_gradients(gaussians, cameras, implementation="cpu", **options)
    first, grads = render_with_gradients(gaussians, cameras, "cuda", implementation="triton", **options)
    second, again = render_with_gradients(gaussians, cameras, "cuda", implementation="triton", **options)
    for value, reference in zip(images(first), images(expected), strict=True):
        assert (value - reference).abs().flatten().quantile(0.99) < 1e-4
    for name in PARAMETERS:
        # A ray whose transmittance passes one half between two Gaussians takes either depth after rounding, and its
        # whole gradient goes to the one or the other: one Gaussian in a thousand may be such a ray's.
        error, norm = (
            (grads[name] - expected_grads[name]).reshape(len(grads[name]), -1).norm(dim=1),
            expected_grads[name].norm(),
        )
        kept = error.sort().values[: -len(error) // 1000] if depth == "median" else error
        assert kept.norm() < (2e-5 if depth == "median" else 1e-4) * norm
        assert error.norm() < 1e-3 * norm
        assert torch.equal(grads[name], again[name])
    assert all(torch.equal(a, b) for a, b in zip(images(first), images(second), strict=True))
