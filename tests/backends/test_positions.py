import pytest
import torch
from torch.nn import functional as F

from backends.positions import Resampling, resize_position_embedding, rotary_2d, rotate, uv_embedding

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


def test_rotary_tables_turn_pairs_of_channels() -> None:
    positions = torch.tensor([[0.0, 0.0], [1.0, 3.0], [2.0, 5.0]])
    features = torch.randn(3, 8, generator=torch.Generator().manual_seed(0))
    found = rotate(features, rotary_2d(positions, 8)).view(3, 2, 2, 2)  # position, axis, part of a pair, pair
    angles = positions[..., None] * torch.tensor([1.0, 0.1])
    pairs = torch.view_as_complex(features.view(3, 2, 2, 2).mT.contiguous()) * torch.polar(torch.ones(3, 2, 2), angles)
    torch.testing.assert_close(found, torch.view_as_real(pairs).mT)


def test_tables_made_in_inference_mode_serve_training_too() -> None:
    like = torch.ones(4, 6, 5, requires_grad=True)
    with torch.inference_mode():
        first = uv_embedding(4, (6, 5), (84, 70), 0.3, like)
    again = uv_embedding(4, (6, 5), (84, 70), 0.3, like)
    (like * again).sum().backward()
    assert torch.equal(like.grad, first)  # pyright: ignore[reportArgumentType]
    assert not torch.equal(first, uv_embedding(4, (6, 5), (84, 84), 0.3, like))
    assert uv_embedding(4, (6, 5), (84, 70), 0.3, like.double()).dtype == torch.float64
