import pytest
import torch
from scipy.spatial import KDTree

from vg2gt.kernels import knn
from vg2gt.kernels.knn import interpolate, interpolation_weights, nearest_by_cells


@pytest.fixture(params=["trees", "cells"], autouse=True)
def search(request, monkeypatch):
    """Everything here holds of the search on a CPU and of the one elsewhere."""
    if request.param == "cells":
        monkeypatch.setattr(knn, "compilable", lambda *_: False)


def points(count, seed):
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(seed)) * 10


CLOUDS = {
    "uniform": lambda: (points(700, 0), points(900, 1)),
    "voxels": lambda: cells_seen(4),
    "full grid": lambda: (torch.cartesian_prod(*[torch.arange(9.0)] * 3),) * 2,
    "one place": lambda: (points(50, 0), torch.ones(300, 3)),
    "far outliers": lambda: (
        torch.cat((points(300, 0), 1e5 * points(9, 3))),
        torch.cat((points(400, 1), 1e5 * points(3, 2))),
    ),
    "line": lambda: (points(300, 0) * torch.tensor([1.0, 0, 0]), points(400, 1) * torch.tensor([1.0, 0, 0]) - 3),
    "queries far away": lambda: (1e4 + points(100, 0), points(400, 1)),
}


def cells_seen(views):
    """Patch points of some views of a wavy wall, in voxels of a seventh of their spacing, and the voxels' centres."""
    columns, rows = torch.meshgrid(torch.arange(32.0), torch.arange(16.0), indexing="ij")
    depth = 2 + torch.sin(columns / 9) + torch.cos(rows / 7)
    view = torch.arange(views)[:, None, None] * 0.31
    places = torch.stack(((columns - 16) / 16 * depth + view, (rows - 8) / 16 * depth + view / 9, depth + 0 * view), -1)
    queries = (places.view(-1, 3) / 0.01).float()
    return queries, torch.unique(queries.floor(), dim=0) + 0.5


@pytest.mark.parametrize("cloud", CLOUDS)
@pytest.mark.parametrize("neighbors", [1, 16])
def test_cells_find_what_a_tree_finds(cloud, neighbors, monkeypatch):
    """Up to ties, and whether queries and candidates fit into one part or not."""
    queries, found_in = CLOUDS[cloud]()
    expected, _ = KDTree(found_in.double().numpy()).query(queries.double().numpy(), k=neighbors)
    zeros = torch.zeros(len(queries) + len(found_in), dtype=torch.int64)
    for at_once, candidates in ((1 << 18, 1 << 23), (97, 1000)):
        monkeypatch.setattr(knn, "QUERIES", at_once)
        monkeypatch.setattr(knn, "CANDIDATES", candidates)
        index, found = nearest_by_cells(queries, zeros[: len(queries)], found_in, zeros[: len(found_in)], neighbors, 1)
        assert found.all()
        assert all(len(row.unique()) == neighbors for row in index)
        distance = (queries.double()[:, None] - found_in.double()[index]).norm(dim=-1)
        torch.testing.assert_close(distance, torch.from_numpy(expected).view(-1, neighbors), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("count", [1, 2, 15])
def test_fewer_points_than_neighbours(count):
    queries, cloud = points(5, 0), points(count, 1)
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


def test_gradients_flow_to_features_and_positions():
    cloud = points(20, 1).double().requires_grad_()
    queries = points(6, 2).double().requires_grad_()
    features = torch.randn(20, 3, dtype=torch.float64, requires_grad=True)

    def run(f, q, c):
        zeros = torch.zeros(20, dtype=torch.int64)
        return interpolate(f, *interpolation_weights(q, zeros[:6], c, zeros, 4, 1))

    assert torch.autograd.gradcheck(run, (features, queries, cloud))


@pytest.mark.parametrize("search", ["cells"], indirect=True)
def test_the_cost_of_the_search_by_cells_is_linear(search, monkeypatch):
    """Counted: distances computed per query, for a scene and for one sixteen times as large and as dense."""
    examined, nearest = [], knn._nearest
    monkeypatch.setattr(knn, "_nearest", lambda *args: (examined.append(args[6]), nearest(*args)))
    per_query = []
    for copies in (1, 16):
        places = torch.arange(copies)[:, None, None] * torch.tensor([500.0, 0, 0])
        queries, found_in = ((places + cloud).view(-1, 3) for cloud in cells_seen(4))
        zeros = torch.zeros(len(queries) + len(found_in), dtype=torch.int64)
        examined.clear()
        nearest_by_cells(queries, zeros[: len(queries)], found_in, zeros[: len(found_in)], 16, 1)
        per_query.append(sum(examined) / len(queries))
    assert 16 < per_query[1] < 1.2 * per_query[0], per_query
