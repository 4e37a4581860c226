"""The Triton kernels against the dense reference: tiny scenes in the interpreter, full size on a GPU."""

import importlib.util
import os
import subprocess
import sys
from dataclasses import replace

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
from vg2gt.rendering import render
from vg2gt.rendering.options import DepthKind, Mode

if importlib.util.find_spec("triton") is None:
    pytest.skip("needs triton, which has wheels for Linux on x86-64 only", allow_module_level=True)
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
runnable = pytest.mark.skipif(DEVICE == "cpu" and not INTERPRETED, reason="runs in test_in_the_interpreter's process")


@pytest.mark.skipif(DEVICE == "cuda" or INTERPRETED, reason="only where the kernels cannot run themselves")
def test_in_the_interpreter() -> None:
    """Runs this file once more, because Triton must be told of its interpreter before it is first imported."""
    environment = {**os.environ, "TRITON_INTERPRET": "1"}
    command = [sys.executable, "-m", "pytest", "-q", __file__]
    result = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout[-5000:]


@runnable
@pytest.mark.parametrize(("mode", "depth"), KINDS)
def test_equals_the_reference(mode: Mode, depth: DepthKind) -> None:
    gaussians, cameras = soup(25, size=0.25), cameras_around((10, 13))
    options = {"mode": mode, "depth": depth}
    expected = render_with_gradients(gaussians, cameras, implementation="dense", **options)
    found = render_with_gradients(gaussians, cameras, DEVICE, implementation="triton", **options)
    assert_same_render(found, expected, atol=1e-11)


@runnable
def test_color_only_and_more_hits_than_expected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vg2gt.rendering.gpu.function.HIT_CAPACITY", 8)
    gaussians, cameras = soup(60, size=0.6), pinhole((3, 4))
    gaussians = replace(gaussians, opacities=gaussians.opacities * 0.2)
    expected = render_with_gradients(gaussians, cameras, implementation="dense", bisections=6)
    out, grads = render_with_gradients(gaussians, cameras, DEVICE, implementation="triton", bisections=6)
    assert_same_render((out, grads), expected, atol=1e-11)
    color = render(
        gaussians.to(DEVICE), cameras.to(DEVICE), "solid", BACKGROUND, implementation="triton", geometry=False
    )
    torch.testing.assert_close(color.color.cpu(), out.color, rtol=0, atol=1e-12)
    assert not color.depth.any()


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
        assert (grads[name] - expected_grads[name]).norm() < 1e-4 * expected_grads[name].norm()
        assert torch.equal(grads[name], again[name])
    assert all(torch.equal(a, b) for a, b in zip(images(first), images(second), strict=True))
