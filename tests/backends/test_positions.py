import math

import pytest
import torch
from torch.nn import functional as F

from backends.network import decode_pose, encode_pose
from backends.positions import Resampling, grid_positions, resize_position_embedding, rotary_2d, rotate, uv_embedding
from vg2gt.geometry.rotations import quat_to_matrix

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


def test_rotation_keeps_lengths_and_depends_on_relative_position() -> None:
    generator = torch.Generator().manual_seed(0)
    query, key = torch.randn(2, 16, generator=generator)

    def score(a: tuple[float, float], b: tuple[float, float]) -> torch.Tensor:
        tables = [rotary_2d(torch.tensor([p]), 16) for p in (a, b)]
        return (rotate(query[None], tables[0]) * rotate(key[None], tables[1])).sum()

    torch.testing.assert_close(score((0, 0), (0, 0)), (query * key).sum())
    torch.testing.assert_close(score((3, 5), (4, 9)), score((10, 20), (11, 24)), rtol=1e-4, atol=1e-4)
    assert (score((3, 5), (4, 9)) - score((3, 5), (9, 4))).abs() > 0.1


def test_first_half_turns_with_y() -> None:
    moved = rotate(torch.ones(1, 16), rotary_2d(torch.tensor([[2.0, 0.0]]), 16))[0]
    assert torch.equal(moved[8:], torch.ones(8))
    assert (moved[:8] != 1).any()
    assert grid_positions(2, 3, like=moved).tolist() == [[0, 0], [0, 1], [0, 2], [1, 0], [1, 1], [1, 2]]


def test_uv_embedding_encodes_x_then_y() -> None:
    embedding = uv_embedding(8, (4, 6), (56, 84), like=torch.zeros(1))
    assert embedding.shape == (8, 4, 6)
    assert (embedding[:4, 0] == embedding[:4, 3]).all()
    assert (embedding[4:, :, 0] == embedding[4:, :, 5]).all()
    x = 1.5 / math.hypot(1.5, 1) * 5 / 6
    torch.testing.assert_close(embedding[0, 0, 5], torch.tensor(math.sin(x)))
    torch.testing.assert_close(embedding[3, 0, 5], torch.tensor(math.cos(x / 10)))


def test_pose_encoding_round_trip() -> None:
    generator = torch.Generator().manual_seed(0)
    pose = torch.eye(4).repeat(2, 3, 1, 1)
    pose[..., :3, :3] = quat_to_matrix(torch.randn(2, 3, 4, generator=generator))
    pose[..., :3, 3] = torch.randn(2, 3, 3, generator=generator)
    intrinsics = torch.tensor([[80.0, 0, 42], [0, 90, 28], [0, 0, 1]]).repeat(2, 3, 1, 1)
    transform, again = decode_pose(encode_pose(pose, intrinsics, (56, 84)), (56, 84))
    torch.testing.assert_close(transform, pose, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(again, intrinsics, rtol=1e-5, atol=1e-4)
