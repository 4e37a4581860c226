import pytest
import torch

from vg2gt.kernels.curve_codes import hilbert_codes, hilbert_reference, z_codes
from vg2gt.method.serialization import ORDERS, make_windows, serial_codes, serial_keys


def cube(bits):
    axis = torch.arange(1 << bits)
    return torch.cartesian_prod(axis, axis, axis)


@pytest.mark.parametrize("bits", [1, 2, 3, 4])
def test_consecutive_hilbert_codes_are_face_neighbours(bits):
    cells = cube(bits)
    codes = hilbert_codes(cells, bits)
    assert torch.equal(codes.sort().values, torch.arange(len(cells)))
    steps = cells[codes.argsort()].diff(dim=0).abs().sum(1)
    assert steps.eq(1).all()


@pytest.mark.parametrize("bits", [1, 9, 21])
def test_compiled_hilbert_codes_equal_the_reference(bits):
    cells = torch.randint(0, 1 << bits, (500, 3))
    assert torch.equal(hilbert_codes(cells, bits), hilbert_reference(cells, bits))
    assert len(hilbert_codes(cells[:0], bits)) == 0


def test_dropping_three_bits_gives_the_parent_and_z_order_interleaves_bits():
    cells = cube(4)
    assert torch.equal(z_codes(cells) >> 3, z_codes(cells >> 1))
    assert torch.equal(hilbert_codes(cells, 4) >> 3, hilbert_codes(cells >> 1, 3))
    for order in ORDERS:
        codes = serial_codes(cells, 4, [order])[0] >> 3
        parents = (cells >> 1) @ torch.tensor([64, 8, 1])
        assert torch.stack((codes, parents), 1).unique(dim=0).shape[0] == 8**3
    cells = torch.tensor([[1, 0, 0], [0, 1, 0], [0, 0, 1], [2, 0, 0], [(1 << 21) - 1, 0, 0]])
    spread = sum(1 << (3 * bit + 2) for bit in range(21))
    assert z_codes(cells).tolist() == [4, 2, 1, 32, spread]


def test_too_large_a_scene_is_refused_with_its_size_and_extent():
    grid = torch.tensor([[0, 0, 0], [(1 << 21) - 1, 0, 0]])
    size = torch.tensor([0.002])
    assert serial_keys(grid, torch.tensor([0, 0]), size, ("z",))[0].min() >= 0
    with pytest.raises(ValueError, match=r"2097152 voxels.*0\.002"):
        serial_keys(grid, torch.tensor([0, 1]), size.repeat(2), ("z",))
    with pytest.raises(ValueError, match="4194304 voxels"):
        serial_keys(torch.tensor([[(1 << 22) - 1, 0, 0]]), torch.tensor([0]), size, ("z",))


@pytest.mark.parametrize("count", [1, 7, 8, 9, 16, 17, 30])
@pytest.mark.parametrize("shift", [0, 4])
def test_every_voxel_is_owned_once_by_a_window_of_its_scene(count, shift):
    counts = [count, 11, 0, 3]
    batch = torch.arange(4).repeat_interleave(torch.tensor(counts))
    order = torch.cat([torch.randperm(n) + sum(counts[:i]) for i, n in enumerate(counts)])
    windows = make_windows(counts, 8, order.device, shift).along(order)
    rows = torch.cat([group.rows.flatten() for group in windows.groups])
    assert torch.equal(rows[windows.owner], torch.arange(len(order)))
    position = order.argsort()
    for group in windows.groups:
        scenes = batch[group.rows]
        assert torch.equal(scenes, scenes[:, :1].expand_as(scenes))
        assert torch.equal(scenes[:, 0].unique_consecutive(return_counts=True)[1], torch.tensor(group.counts))
        assert position[group.rows].diff(dim=1).eq(1).all()
        assert group.rows.shape[1] == min(8, counts[int(scenes[0, 0])])
