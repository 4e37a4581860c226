"""The Triton kernels against the dense reference: tiny scenes in the interpreter, full size on a GPU."""

import importlib.util
import os
import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.rendering.scenes import (
    KINDS,
    PARAMETERS,
    cameras_around,
    images,
    pinhole,
    random_like,
    soup,
    wall,
    with_gradients,
)
from vg2gt.rendering import render
from vg2gt.rendering.options import DepthKind, Mode
from vg2gt.rendering.renderer import Implementation
from vg2gt.types import Cameras, Gaussians, Render

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


def render_with_gradients(
    gaussians: Gaussians, cameras: Cameras, implementation: Implementation, device: str, **options: object
) -> tuple[Render, list[Tensor]]:
    """A render and the gradients of a random weighting of all its images, on the CPU."""
    gaussians, cameras = with_gradients(gaussians.to(device)), cameras.to(device)
    poses = cameras.world_to_camera.clone().requires_grad_()
    out = render(
        gaussians,
        replace(cameras, world_to_camera=poses),
        background=(0.3, 0.1, 0.7),
        implementation=implementation,
        **options,  # type: ignore[arg-type]
    )
    weights = [weight.to(device) for weight in random_like(out)]
    grads = torch.autograd.grad(images(out), [*(getattr(gaussians, name) for name in PARAMETERS), poses], weights)
    return out.to("cpu"), [grad.cpu() for grad in grads]


@runnable
@pytest.mark.parametrize(("mode", "depth"), KINDS)
def test_equals_the_reference(mode: Mode, depth: DepthKind) -> None:
    gaussians, cameras = soup(25, size=0.25), cameras_around((10, 13))
    options = {"mode": mode, "depth": depth}
    expected, expected_grads = render_with_gradients(gaussians, cameras, "dense", "cpu", **options)
    out, grads = render_with_gradients(gaussians, cameras, "triton", DEVICE, **options)
    assert (expected.depth > 0).any()
    for value, reference in zip(images(out), images(expected), strict=True):
        torch.testing.assert_close(value, reference, rtol=0, atol=1e-11)
    for grad, reference in zip(grads, expected_grads, strict=True):
        assert (grad - reference).norm() < 1e-10 * reference.norm()


@runnable
def test_color_only_and_more_hits_than_expected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vg2gt.rendering.gpu.function.HIT_CAPACITY", 8)
    gaussians, cameras = soup(60, size=0.6), pinhole((3, 4))
    gaussians = replace(gaussians, opacities=gaussians.opacities * 0.2)
    expected, expected_grads = render_with_gradients(gaussians, cameras, "dense", "cpu", bisections=6)
    out, grads = render_with_gradients(gaussians, cameras, "triton", DEVICE, bisections=6)
    assert (expected.depth > 0).any()
    torch.testing.assert_close(out.depth, expected.depth, rtol=0, atol=1e-11)
    for grad, reference in zip(grads, expected_grads, strict=True):
        assert (grad - reference).norm() < 1e-10 * reference.norm()
    color = render(
        gaussians.to(DEVICE), cameras.to(DEVICE), "solid", (0.3, 0.1, 0.7), implementation="triton", geometry=False
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
    gaussians, cameras = wall(50_000, (224, 448))
    gaussians = gaussians.map(lambda t: t.float() if t.is_floating_point() else t)
    cameras = cameras.map(Tensor.float)
    expected, expected_grads = render_with_gradients(gaussians, cameras, "cpu", "cpu", mode=mode, depth=depth)
    first, grads = render_with_gradients(gaussians, cameras, "triton", "cuda", mode=mode, depth=depth)
    second, again = render_with_gradients(gaussians, cameras, "triton", "cuda", mode=mode, depth=depth)
    for value, reference in zip(images(first), images(expected), strict=True):
        assert (value - reference).abs().flatten().quantile(0.99) < 1e-4
    for grad, reference in zip(grads[:5], expected_grads[:5], strict=True):
        assert (grad - reference).norm() < 1e-4 * reference.norm()
    assert all(
        torch.equal(a, b) for a, b in zip([*images(first), *grads[:5]], [*images(second), *again[:5]], strict=True)
    )
