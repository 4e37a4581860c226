import pytest
import torch

from vg2gt.voxels.knn import interpolate, interpolation_weights, nearest_neighbors


def points(count, seed):
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(seed)) * 10


def test_equals_brute_force():
    queries, cloud = points(50, 0), points(70, 1)
    distances = torch.cdist(queries.double(), cloud.double())
    found = nearest_neighbors(queries, cloud, 16)
    torch.testing.assert_close(distances.gather(1, found), distances.sort(1).values[:, :16], atol=1e-6, rtol=0)


@pytest.mark.parametrize("count", [1, 2, 15])
def test_fewer_points_than_neighbours(count):
    queries, cloud = points(5, 0), points(count, 1)
    assert nearest_neighbors(queries, cloud, 16).shape == (5, count)
    zeros = torch.zeros(5, dtype=torch.int64)
    index, weights = interpolation_weights(queries, zeros, cloud, zeros.new_zeros(count), 16, 1)
    assert index.shape == weights.shape == (5, 16)
    torch.testing.assert_close(weights.sum(1), torch.ones(5))
    torch.testing.assert_close(interpolate(torch.ones(count, 3), index, weights), torch.ones(5, 3))


def test_scenes_do_not_mix_and_distances_weigh_as_documented():
    """Scene 1 has points and no queries, scene 3 neither."""
    cloud, batch = torch.cat((points(20, 1), points(5, 3), points(30, 1))), torch.tensor([0] * 20 + [1] * 5 + [2] * 30)
    queries, query_batch = torch.cat((points(4, 2), points(4, 2))), torch.tensor([0] * 4 + [2] * 4)
    index, weights = interpolation_weights(queries, query_batch, cloud, batch, 6, 4)
    assert torch.equal(batch[index], query_batch[:, None].expand_as(index))
    squared = (queries[:, None] - cloud[index]).square().sum(-1)
    expected = 1 / (squared + 1e-6)
    torch.testing.assert_close(weights, expected / expected.sum(1, keepdim=True))


def test_a_query_on_a_centre_returns_its_feature():
    cells = torch.cartesian_prod(*[torch.arange(4)] * 3).float() + 0.5
    batch = torch.zeros(len(cells), dtype=torch.int64)
    features = torch.randn(len(cells), 5, generator=torch.Generator().manual_seed(0))
    index, weights = interpolation_weights(cells, batch, cells, batch, 16, 1)
    torch.testing.assert_close(interpolate(features, index, weights), features, atol=1e-4, rtol=0)


def test_gradients_flow_to_features_and_positions():
    cloud = points(20, 1).double().requires_grad_()
    queries = points(6, 2).double().requires_grad_()
    features = torch.randn(20, 3, dtype=torch.float64, requires_grad=True)

    def run(f, q, c):
        zeros = torch.zeros(20, dtype=torch.int64)
        return interpolate(f, *interpolation_weights(q, zeros[:6], c, zeros, 4, 1))

    assert torch.autograd.gradcheck(run, (features, queries, cloud))
