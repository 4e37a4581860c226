"""The median depth against a root finder, and its implicit gradient."""

import math

import pytest
import torch
from scipy.optimize import root_scalar
from torch import Tensor

from vg2gt.rendering.median import MedianDepth
from vg2gt.rendering.options import RenderOptions

EXACT = RenderOptions(bisections=60, newton_steps=2, slope_floor=0.0)


def random_rays(rays: int, hits: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Opacities, peaks (metres, three surfaces) and precisions (1 mm to 2 cm) of random rays."""
    generator = torch.Generator().manual_seed(seed)

    def uniform() -> Tensor:
        return torch.rand(rays, hits, generator=generator, dtype=torch.float64)

    alpha = 0.02 + 0.9 * uniform()
    peak = 2 + torch.randint(3, (rays, hits), generator=generator).double() * 0.7 + 0.02 * uniform()
    return alpha, peak, (0.001 * 20 ** uniform()) ** -2


def solve(alpha: Tensor, peak: Tensor, precision: Tensor, options: RenderOptions = EXACT) -> Tensor:
    before = torch.cumprod(1 - alpha.detach(), -1) / (1 - alpha.detach())
    depth = MedianDepth.apply(alpha, peak, precision, before, options)
    assert isinstance(depth, Tensor)
    return depth


def transmittance(t: float, alpha: Tensor, peak: Tensor, precision: Tensor) -> float:
    """Product of vacancies up to every peak, and of opacity over vacancy behind it."""
    total = 1.0
    for a, p, w in zip(alpha.tolist(), peak.tolist(), precision.tolist(), strict=True):
        vacancy = math.sqrt(1 - a * math.exp(-0.5 * w * (t - p) ** 2))
        total *= vacancy if t <= p else (1 - a) / vacancy
    return total


@pytest.mark.parametrize(
    ("options", "tolerance"),
    [(EXACT, 1e-9), (RenderOptions(), 1e-5), (RenderOptions(bisections=20, newton_steps=0), 2e-6)],
)
def test_median_against_a_root_finder(options: RenderOptions, tolerance: float) -> None:
    alpha, peak, precision = random_rays(60, 12)
    depth = solve(alpha, peak, precision, options)
    assert (depth > 0).sum() > 50
    for row in torch.nonzero(depth > 0)[:, 0]:
        ray = (alpha[row], peak[row], precision[row])
        found = root_scalar(lambda t, ray=ray: transmittance(t, *ray) - 0.5, bracket=(0.5, 6.0), xtol=1e-10)
        assert abs(float(depth[row]) - found.root) < tolerance


def test_gradient_against_finite_differences() -> None:
    alpha, peak, precision = random_rays(12, 5, seed=3)
    scale = precision.mean()
    inputs = tuple(t.clone().requires_grad_() for t in (alpha, peak, precision / scale))
    assert torch.autograd.gradcheck(lambda a, p, w: solve(a, p, w * scale), inputs, eps=1e-7, atol=1e-4, rtol=1e-4)


def test_transparent_rays_and_medians_before_the_near_plane_have_no_depth() -> None:
    alpha = torch.tensor([[0.5], [0.6], [0.6]], dtype=torch.float64)
    peak = torch.tensor([[2.0], [2.0], [0.3]], dtype=torch.float64)
    depth = solve(alpha, peak, torch.full_like(peak, 1e4), RenderOptions(near=0.5))
    assert depth[0] == 0
    assert depth[1] > 0
    assert depth[2] == 0


def test_slope_floor_bounds_the_gradient_on_a_plateau() -> None:
    alpha = torch.tensor([[1 - 0.5 * (1 + 1e-9), 0.5]], dtype=torch.float64)  # T stays near one half in between
    peak = torch.tensor([[2.0, 4.0]], dtype=torch.float64)
    precision = torch.full_like(peak, 25.0)
    gradients = []
    for floor in (0.0, 30.0):
        a = alpha.clone().requires_grad_()
        solve(a, peak, precision, RenderOptions(bisections=60, slope_floor=floor)).sum().backward()
        gradients.append(float(a.grad.abs().max()))
    assert gradients[1] < 0.21
    assert gradients[0] > 10 * gradients[1]
