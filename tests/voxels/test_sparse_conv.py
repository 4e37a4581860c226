import pytest
import torch
from torch.nn import functional as F

from tests.gpu_counts import Operations
from vg2gt.method import sparse_conv
from vg2gt.method.sparse_conv import Cells, SubmanifoldConv3d, neighbor_pairs, neighbor_tables


def neighbor_table(grid, batch, kernel_size):
    (table,) = neighbor_tables([Cells(grid, batch, kernel_size)])
    return table


@pytest.fixture(params=[neighbor_pairs, neighbor_table])
def find(request):
    """Everything here holds of the convolution on a CPU and of the one elsewhere."""
    return request.param


def dense_result(conv, features, grid, batch):
    low, high = grid.amin(0), grid.amax(0)
    volume = features.new_zeros(int(batch.max()) + 1, features.shape[1], *(high - low + 1).tolist())
    x, y, z = (grid - low).unbind(-1)
    volume[batch, :, x, y, z] = features
    out = F.conv3d(volume, conv.weight.permute(0, 4, 1, 2, 3), conv.bias, padding=conv.kernel_size // 2)
    return out[batch, :, x, y, z]


@pytest.mark.parametrize("kernel_size", [3, 5])
@pytest.mark.parametrize("held", [1 << 28, 2000])
def test_equals_dense_convolution_with_gradients(kernel_size, held, find, random_voxels, monkeypatch):
    monkeypatch.setattr(sparse_conv, "HELD", held)
    grid, batch = random_voxels((150, 100), extent=7)  # dense enough to touch every border and offset
    conv = SubmanifoldConv3d(4, 3, kernel_size).double()
    features = torch.randn(len(grid), 4, dtype=torch.float64, requires_grad=True)
    pairs = find(grid, batch, kernel_size)
    assert all(len(i) for i, _ in neighbor_pairs(grid, batch, kernel_size))
    out, dense = conv(features, pairs), dense_result(conv, features, grid, batch)
    torch.testing.assert_close(out, dense, atol=1e-12, rtol=1e-12)
    probe, inputs = torch.randn_like(out), (features, conv.weight, conv.bias)
    ours, reference = (torch.autograd.grad(result, inputs, probe) for result in (out, dense))
    torch.testing.assert_close(ours, reference, atol=1e-11, rtol=1e-11)


def test_pairs_are_the_same_however_many_offsets_are_looked_up_at_once(random_voxels, monkeypatch):
    grid, batch = random_voxels((60, 40), extent=6)
    together = neighbor_pairs(grid, batch, 3)
    monkeypatch.setattr(sparse_conv, "CHUNK", 5 * len(grid))
    assert len(together) == 13
    for ours, theirs in zip(neighbor_pairs(grid, batch, 3), together, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))


def test_sets_of_cells_searched_together_have_the_tables_of_each_alone(random_voxels):
    sets = []
    for counts, extent, size in (((60, 40), 7, 3), ((9, 0), 3, 3), ((60, 40), 7, 5)):
        grid, batch = random_voxels(counts, extent=extent)
        low = torch.stack([grid[batch == b].amin(0) if (batch == b).any() else grid[0] for b in range(2)])
        sets.append(Cells(grid - low[batch], batch, size, (2 * extent + 1, 2 * extent + 1, 2 * extent + 1, 2)))
    for found, cells in zip(neighbor_tables(sets), sets, strict=True):
        alone = neighbor_table(cells.grid, cells.batch, cells.kernel_size)
        for one, other in zip(vars(found).values(), vars(alone).values(), strict=True):
            assert torch.equal(one, other)


def test_bfloat16_products_are_summed_in_float32(find, random_voxels):
    """Within the rounding of the factors; sums of 27 numbers of bfloat16 would be off by more."""
    grid, batch = random_voxels((150, 100), extent=7)
    conv, features = SubmanifoldConv3d(16, 8, 3), torch.randn(len(grid), 16, requires_grad=True)
    expected = conv.double()(features.double(), find(grid, batch, 3))
    (wanted,) = torch.autograd.grad(expected.square().sum(), features)
    with torch.autocast("cpu", torch.bfloat16):
        out = conv.float()(features, find(grid, batch, 3))
    (grad,) = torch.autograd.grad(out.float().square().sum(), features)
    assert out.dtype == torch.bfloat16
    assert grad.dtype == torch.float32
    assert (out - expected).norm() < 4e-3 * expected.norm()
    assert (grad - wanted).norm() < 8e-3 * wanted.norm()


def test_operations_on_a_gpu_do_not_depend_on_the_number_of_offsets(random_voxels):
    grid, batch = random_voxels((150, 100), extent=7)
    counts = []
    for kernel_size in (3, 5):
        conv, features = SubmanifoldConv3d(4, 3, kernel_size), torch.randn(len(grid), 4, requires_grad=True)
        with Operations() as operations:
            conv(features, neighbor_table(grid, batch, kernel_size)).sum().backward()
        counts.append(operations.places.total())
    assert 0 < counts[1] <= counts[0] < 150, counts
