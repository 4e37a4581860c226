import math

import pytest
import torch

from vg2gt.geometry.rotations import quat_to_matrix
from vg2gt.geometry.spherical_harmonics import basis, rgb_to_sh, rotation_of_coefficients, sh_to_rgb


def sphere(count: int) -> torch.Tensor:
    """Nearly uniform directions (golden spiral)."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    z, angle = 1 - 2 * i / count, math.pi * (1 + 5**0.5) * i
    radius = (1 - z * z).sqrt()
    return torch.stack((radius * angle.cos(), radius * angle.sin(), z), -1)


def test_order_and_signs_are_those_of_gaussian_splatting() -> None:
    """Degree 1 is (-y, z, -x); each band is checked at one direction against the textbook polynomials."""
    x, y, z = 0.48, 0.6, 0.64
    values = basis(torch.tensor([x, y, z], dtype=torch.float64), 3)
    pi = math.pi
    c1, c2, c3 = math.sqrt(3 / (4 * pi)), math.sqrt(15 / (4 * pi)), math.sqrt(105 / (4 * pi))
    expected = [
        math.sqrt(1 / (4 * pi)),
        *(-c1 * y, c1 * z, -c1 * x),
        *(c2 * x * y, -c2 * y * z, math.sqrt(5 / (16 * pi)) * (3 * z * z - 1), -c2 * x * z, c2 / 2 * (x * x - y * y)),
        -math.sqrt(35 / (32 * pi)) * y * (3 * x * x - y * y),
        c3 * x * y * z,
        -math.sqrt(21 / (32 * pi)) * y * (5 * z * z - 1),
        math.sqrt(7 / (16 * pi)) * z * (5 * z * z - 3),
        -math.sqrt(21 / (32 * pi)) * x * (5 * z * z - 1),
        c3 / 2 * z * (x * x - y * y),
        -math.sqrt(35 / (32 * pi)) * x * (x * x - 3 * y * y),
    ]
    torch.testing.assert_close(values, torch.tensor(expected, dtype=torch.float64))


def test_colours_come_back_are_not_negative_and_of_degree_3_at_most() -> None:
    rgb = torch.rand(5, 3, generator=torch.Generator().manual_seed(0))
    directions = sphere(5).float()
    torch.testing.assert_close(sh_to_rgb(rgb_to_sh(rgb)[:, None], directions), rgb)
    sh = torch.zeros(5, 4, 3)
    sh[:, 0] = -10
    assert (sh_to_rgb(sh, directions) == 0).all()
    with pytest.raises(ValueError, match="0 to 3, got 4"):
        basis(torch.zeros(3), 4)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_turned_coefficients_are_the_turned_function(degree: int) -> None:
    generator = torch.Generator().manual_seed(0)
    turns = quat_to_matrix(torch.randn(5, 4, generator=generator, dtype=torch.float64))
    coefficients = torch.randn((degree + 1) ** 2, 3, generator=generator, dtype=torch.float64)
    matrices = rotation_of_coefficients(turns, degree)
    directions = sphere(50)
    for turn, matrix in zip(turns, matrices, strict=True):
        turned = basis(directions @ turn.T, degree) @ (matrix @ coefficients)
        torch.testing.assert_close(turned, basis(directions, degree) @ coefficients, atol=1e-12, rtol=0)
