"""What the networks over voxels have in common."""

import pytest
import torch

from tests.voxels.test_pointmlp import network
from vg2gt.method import PointMLP

SIZE = torch.full((2,), 0.125)


@pytest.fixture(params=["PTv3", "PointMLP"])
def net(request, make_ptv3):
    return make_ptv3().double().eval() if request.param == "PTv3" else network()


def features_of(grid, net):
    channels = 6 if isinstance(net, PointMLP) else 8
    return torch.randn(len(grid), channels, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


def test_permuting_voxels_permutes_the_result(random_voxels, net):
    grid, batch = random_voxels()
    features, order = features_of(grid, net), torch.cat((torch.randperm(90), 90 + torch.randperm(60)))
    out = net(features, grid, batch, SIZE)
    torch.testing.assert_close(net(features[order], grid[order], batch[order], SIZE), out[order], atol=1e-6, rtol=0)


def test_shifting_scenes_by_whole_voxels_changes_nothing(random_voxels, net):
    grid, batch = random_voxels()
    features, shift = features_of(grid, net), torch.tensor([[7, -11, 300], [-5, 0, 64]])[batch]
    assert torch.equal(net(features, grid + shift, batch, SIZE), net(features, grid, batch, SIZE))


def test_a_batch_equals_separate_runs(random_voxels, net):
    grid, batch = random_voxels((90, 5))
    grid = grid * torch.where(batch == 1, 9, 1)[:, None]  # extents of different bit lengths
    features = features_of(grid, net)
    together = net(features, grid, batch, SIZE)
    tolerance = 1e-12 if isinstance(net, PointMLP) else 1e-10
    for rows in (batch == 0, batch == 1):
        alone = net(features[rows], grid[rows], torch.zeros_like(batch[rows]), SIZE[:1])
        torch.testing.assert_close(together[rows], alone, atol=tolerance, rtol=0)
