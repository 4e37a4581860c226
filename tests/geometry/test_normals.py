import math

import torch

from vg2gt.geometry.cameras import ray_directions
from vg2gt.geometry.normals import normals_from_depth

SIZE = (24, 30)
K = torch.tensor([[33.0, 0, 14.2], [0, 29, 11.9], [0, 0, 1]], dtype=torch.float64)


def wavy_depth() -> torch.Tensor:
    y, x = torch.meshgrid(torch.linspace(0, 4, SIZE[0]), torch.linspace(0, 5, SIZE[1]), indexing="ij")
    return (3 + 0.05 * torch.sin(x) + 0.04 * torch.cos(2 * y)).double()


def test_equals_the_cross_product_of_central_differences() -> None:
    depth = wavy_depth()
    points = ray_directions(K, SIZE) * depth[..., None]
    dx, dy = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    expected = torch.nn.functional.normalize(torch.linalg.cross(dy, dx), dim=-1).permute(2, 0, 1)
    normals, valid = normals_from_depth(depth, K)
    assert valid[1:-1, 1:-1].all()
    torch.testing.assert_close(normals[:, 1:-1, 1:-1], expected)
    facing = (normals[:, 1:-1, 1:-1] * points[1:-1, 1:-1].permute(2, 0, 1)).sum(0)
    assert (facing < 0).all()


def test_holes_and_depth_edges_have_no_normal() -> None:
    depth = torch.full(SIZE, 1.0, dtype=torch.float64)
    depth[:, 15:] = 1.1  # a step of 10 %
    depth[5, 5] = 0
    _, valid = normals_from_depth(depth, K)
    expected = torch.zeros(SIZE, dtype=torch.bool)
    expected[1:-1, 1:-1] = True
    expected[:, 14:16] = False
    expected[4:7, 5] = expected[5, 4:7] = False
    assert torch.equal(valid, expected)
    _, wide = normals_from_depth(depth, K, edge_threshold=0.2)
    assert wide[10, 14]


def test_gradients_are_right_and_finite_with_holes() -> None:
    depth = wavy_depth()[:6, :7].clone()
    depth[2, 2] = 0
    depth.requires_grad_()

    def weighted(d: torch.Tensor) -> torch.Tensor:
        normals, _ = normals_from_depth(d, K, edge_threshold=0.3)
        return (normals * torch.arange(normals.numel(), dtype=torch.float64).view_as(normals)).sum()

    (gradient,) = torch.autograd.grad(weighted(depth), depth)
    assert torch.isfinite(gradient).all()
    assert gradient[2, 2] == 0
    assert (gradient != 0).any()
    step = 1e-6
    moved = depth.detach().clone()
    moved[4, 4] += step
    numeric = float(weighted(moved) - weighted(depth).detach()) / step
    assert math.isclose(numeric, float(gradient[4, 4]), rel_tol=1e-4)
