import math

import pytest
import torch

from vg2gt.geometry.rotations import quat_to_matrix
from vg2gt.geometry.symmetric import principal_direction, smallest_eigenvector


def _with_values(values: tuple[float, ...], count: int) -> torch.Tensor:
    turns = quat_to_matrix(torch.randn(count, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    return turns @ torch.diag(torch.tensor(values, dtype=torch.float64)) @ turns.mT


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [1e-12, 1.0, 1e12])
@pytest.mark.parametrize("values", [(1.0, 2.0, 3.0), (0.0, 1.0, 1.0), (1e-5, 0.08, 0.09), (0.0, 1e-3, 1.0)])
def test_the_eigenvector_of_the_smallest_value(dtype: torch.dtype, size: float, values: tuple[float, ...]) -> None:
    matrix = (size * _with_values(values, 200)).to(dtype)
    found = smallest_eigenvector(matrix, torch.zeros(200, 3, dtype=dtype))
    expected = torch.linalg.eigh(matrix.double()).eigenvectors[..., 0]
    assert found.dtype == dtype
    assert (found.double() * expected).sum(-1).abs().min() > 1 - 1e-6


@pytest.mark.parametrize("values", [(1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (2.0, 2.0, 3.0)])
def test_where_no_direction_is_the_smallest_the_fallback_is_returned(values: tuple[float, ...]) -> None:
    fallback = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=-1)
    torch.testing.assert_close(smallest_eigenvector(_with_values(values, 50), fallback), fallback)


def test_principal_direction() -> None:
    angle = torch.linspace(-3, 3, 41, dtype=torch.float64)
    d = torch.stack((angle.cos(), angle.sin()), -1)
    matrix = 5 * d[:, :, None] * d[:, None] + torch.eye(2)
    found, value = principal_direction(matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 1])
    torch.testing.assert_close((found * d).sum(-1).abs(), torch.ones(41, dtype=torch.float64))
    torch.testing.assert_close(value, torch.full((41,), 6.0, dtype=torch.float64))
    found, value = principal_direction(*torch.tensor([[2.0], [0.0], [2.0]]))
    assert found[0].tolist() == [1.0, 0.0]
    assert math.isclose(float(value), 2.0)
