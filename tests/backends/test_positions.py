import pytest
import torch
from torch.nn import functional as F

from backends.positions import Resampling, resize_position_embedding

GRIDS = [(16, 32), (37, 37), (37, 30), (5, 7), (60, 80), (1, 2)]


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("resampling", ["size", "scale"])
def test_resize_equals_bicubic_interpolation(grid: tuple[int, int], resampling: Resampling) -> None:
    side = 37
    embedding = torch.randn(side * side, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    image = embedding.T.reshape(1, 5, side, side)
    if resampling == "size":
        expected = F.interpolate(image, grid, mode="bicubic", antialias=True)
    elif grid == (side, side):
        expected = image
    else:
        factors = [(n + 0.1) / side for n in grid]
        expected = F.interpolate(image, scale_factor=factors, mode="bicubic")
        assert expected.shape[-2:] == grid
    result = resize_position_embedding(embedding, grid, resampling)
    torch.testing.assert_close(result, expected[0].flatten(1).T, rtol=0, atol=1e-6)
