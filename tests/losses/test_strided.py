"""Neighbours read together."""

import pytest
import torch

from tests.gpu_counts import as_on_a_gpu
from vg2gt.losses.strided import neighbor_pairs, pixel_squares


@pytest.mark.parametrize("made", [neighbor_pairs, pixel_squares])
def test_slices_and_indices_read_the_same_with_the_same_gradient(made) -> None:
    """At a size that no stride divides."""
    neighbors = made((7, 10), (1, 2, 4), torch.device("cpu"))
    maps = torch.rand(2, 3, 7, 10, dtype=torch.float64, requires_grad=True)
    read = neighbors.read(maps)
    plain = maps[..., neighbors.rows, neighbors.columns]
    with as_on_a_gpu():
        assert torch.equal(neighbors.read(maps), plain)
    assert torch.equal(read, plain)
    assert len(neighbors.rows) == (4 if made is pixel_squares else 2)
    weights = torch.rand_like(plain)
    found, expected = (torch.autograd.grad((x * weights).sum(), maps)[0] for x in (read, plain))
    torch.testing.assert_close(found, expected)
    moves = (neighbors.rows[-1] - neighbors.rows[0]) + (neighbors.columns[-1] - neighbors.columns[0])
    assert torch.equal(moves, neighbors.stride.long() * (len(neighbors.rows) // 2))
    assert neighbors.sums(torch.ones(neighbors.rows.shape[1])).tolist() == neighbors.lengths
