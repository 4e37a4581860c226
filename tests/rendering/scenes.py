"""Small scenes and cameras for the renderer's tests."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from vg2gt.rendering import render
from vg2gt.types import Cameras, Gaussians, Render

IMPLEMENTATIONS = ("dense", "cpu")
KINDS = (("solid", "median"), ("rasterized", "median"), ("rasterized", "expected"))
BACKGROUND = (0.3, 0.1, 0.7)
PARAMETERS = ("means", "quats", "scales", "opacities", "sh")


def soup(count: int, seed: int = 0, degree: int = 0, scenes: int = 1, size: float = 0.15) -> Gaussians:
    """Random anisotropic Gaussians of any orientation, 2 to 4 units in front of the origin, ``count`` a scene."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    total = count * scenes
    depth = 2 + 2 * uniform(total)
    means = torch.stack(((uniform(total) - 0.5) * depth, (uniform(total) - 0.5) * depth, depth), -1)
    return Gaussians(
        means=means,
        quats=normal(total, 4) * (0.5 + uniform(total, 1)),
        scales=size * torch.exp(0.6 * normal(total, 3)),
        opacities=0.2 + 0.75 * uniform(total),
        sh=normal(total, (degree + 1) ** 2, 3) * (0.3 if degree else 1.0),
        batch=torch.arange(scenes).repeat_interleave(count),
    )


def wall(count: int, size: tuple[int, int], seed: int = 0) -> tuple[Gaussians, Cameras]:
    """Flat pixel-sized Gaussians on a slanted, bent wall 2 to 4 m away that fills the image: the regime of training."""
    generator = torch.Generator().manual_seed(seed)
    height, width = size
    focal = 0.8 * width
    pixel = torch.rand(count, 2, generator=generator, dtype=torch.float64) * torch.tensor([width, height])
    rays = (pixel - torch.tensor([width / 2, height / 2])) / focal
    depth = 3 + 0.8 * rays[:, 0] + 0.3 * torch.sin(6 * rays[:, 1])
    depth = depth * (1 + 0.001 * torch.randn(count, generator=generator, dtype=torch.float64))
    means = torch.cat((rays, torch.ones(count, 1, dtype=torch.float64)), -1) * depth[:, None]
    spacing = (height * width / count) ** 0.5
    jitter = torch.exp(0.25 * torch.randn(count, 3, generator=generator, dtype=torch.float64))
    scales = 0.9 * spacing * depth[:, None] / focal * jitter * torch.tensor([1.0, 1.0, 0.25])
    gaussians = Gaussians(
        means=means,
        quats=torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
        + 0.1 * torch.randn(count, 4, generator=generator, dtype=torch.float64),
        scales=scales,
        opacities=torch.sigmoid(0.8 + 1.2 * torch.randn(count, generator=generator, dtype=torch.float64)),
        sh=torch.randn(count, 1, 3, generator=generator, dtype=torch.float64),
        batch=torch.zeros(count, dtype=torch.int64),
    )
    cameras = pinhole(size, focal=(focal, focal))
    return gaussians, cameras


def pinhole(size: tuple[int, int], focal: tuple[float, float] = (30.0, 28.0)) -> Cameras:
    """One camera at the origin, looking along z, principal point in the middle."""
    height, width = size
    intrinsics = torch.tensor([[focal[0], 0, width / 2], [0, focal[1], height / 2], [0, 0, 1]], dtype=torch.float64)
    return Cameras(torch.eye(4, dtype=torch.float64)[None, None], intrinsics[None, None], size)


def cameras_around(size: tuple[int, int], scenes: int = 1, views: int = 2) -> Cameras:
    """Views near the origin with different poses and intrinsics."""
    single = pinhole(size)
    poses, intrinsics = [], []
    for index in range(scenes * views):
        angle = torch.tensor(0.15 * index - 0.1, dtype=torch.float64)
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 0] = pose[2, 2] = angle.cos()
        pose[0, 2], pose[2, 0] = angle.sin(), -angle.sin()
        pose[:3, 3] = torch.tensor([0.05 - 0.1 * index, -0.03 + 0.07 * index, 0.1 - 0.1 * index])
        poses.append(pose)
        intrinsics.append(single.intrinsics[0, 0] * torch.tensor([[1 + 0.05 * index], [1.0], [1.0]]))
    return Cameras(
        torch.stack(poses).view(scenes, views, 4, 4), torch.stack(intrinsics).view(scenes, views, 3, 3), size
    )


def with_gradients(gaussians: Gaussians) -> Gaussians:
    """Copies whose floating-point tensors require gradients."""
    return gaussians.map(lambda t: t.clone().requires_grad_() if t.is_floating_point() else t)


def floats_to(value: Any, dtype: torch.dtype) -> Any:
    """A record of tensors whose floating-point ones have another dtype."""
    return value.map(lambda t: t.to(dtype) if t.is_floating_point() else t)


def images(render: Render) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Colour, depth, normal, alpha."""
    return render.color, render.depth, render.normal, render.alpha


def random_like(render: Render, seed: int = 0) -> tuple[Tensor, ...]:
    """One random weight image for each image of a render."""
    generator = torch.Generator().manual_seed(seed)
    return tuple(torch.randn(i.shape, generator=generator, dtype=torch.float64).to(i.dtype) for i in images(render))


def render_with_gradients(
    gaussians: Gaussians, cameras: Cameras, device: str = "cpu", **options: Any
) -> tuple[Render, dict[str, Tensor]]:
    """A render on a device and the gradients of a random weighting of all its images in every input, on the CPU."""
    gaussians, cameras = with_gradients(gaussians.to(device)), cameras.to(device)
    poses, intrinsics = cameras.world_to_camera.clone().requires_grad_(), cameras.intrinsics.clone().requires_grad_()
    background = torch.tensor(BACKGROUND, dtype=poses.dtype, device=device).requires_grad_()
    out = render(gaussians, Cameras(poses, intrinsics, cameras.size), background=background, **options)
    inputs = {name: getattr(gaussians, name) for name in PARAMETERS}
    inputs |= {"world_to_camera": poses, "intrinsics": intrinsics, "background": background}
    weights = [weight.to(device) for weight in random_like(out)]
    grads = torch.autograd.grad(images(out), list(inputs.values()), weights)
    return out.to("cpu"), {name: grad.cpu() for name, grad in zip(inputs, grads, strict=True)}


def assert_same_render(
    found: tuple[Render, dict[str, Tensor]], expected: tuple[Render, dict[str, Tensor]], atol: float = 1e-12
) -> None:
    """Images equal to ``atol``, gradients to 1e-10 of their norm; the reference has depth somewhere."""
    assert (expected[0].depth > 0).any()
    for value, reference in zip(images(found[0]), images(expected[0]), strict=True):
        torch.testing.assert_close(value, reference, rtol=0, atol=atol)
    for name, reference in expected[1].items():
        assert (found[1][name] - reference).norm() < 1e-10 * reference.norm(), name
