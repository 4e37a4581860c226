import math

import pytest
import torch

from vg2gt.method.grid import mixed_radix_keys, plan_voxels, point_cells, pool_mean, pool_min, scene_voxel_size
from vg2gt.types import Cameras, Geometry

SIZE = torch.tensor([0.125, 0.25])


def cloud(count=400, seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 3, generator=generator, dtype=dtype) * 1.2 - 0.6
    batch = (torch.arange(count) >= count // 3).long()
    values = torch.randn(count, 5, generator=generator, dtype=dtype)
    weights = 1 + torch.rand(count, generator=generator, dtype=dtype)
    return points, batch, values, weights


def planned(points, batch, valid=None, size=SIZE):
    valid = torch.ones_like(batch, dtype=torch.bool) if valid is None else valid
    return plan_voxels(point_cells(points, batch, size), batch, valid)


def brute_force(points, batch, values, weights, valid):
    cells = {}
    for i in range(len(points)):
        if valid[i]:
            v = float(SIZE[batch[i]])
            key = (int(batch[i]), *(math.floor(float(x) / v) for x in points[i]))
            cells.setdefault(key, []).append(i)
    rows = [cells[key] for key in sorted(cells)]
    mean = torch.stack([(values[r] * weights[r, None]).sum(0) / weights[r].sum() for r in rows])
    return sorted(cells), rows, mean, torch.stack([weights[r].min() for r in rows])


def test_pooling_equals_a_dictionary_loop():
    points, batch, values, weights = cloud()
    valid = torch.rand(len(batch), generator=torch.Generator().manual_seed(1)) > 0.2
    plan = planned(points, batch, valid)
    keys, rows, mean, least = brute_force(points, batch, values, weights, valid)
    assert torch.cat((plan.batch[:, None], plan.grid), 1).tolist() == [list(key) for key in keys]
    assert plan.counts.tolist() == [len(r) for r in rows]
    torch.testing.assert_close(pool_mean(values, weights, plan), mean, atol=1e-12, rtol=1e-12)
    assert torch.equal(pool_min(weights, plan), least)
    for voxel, members in enumerate(rows):
        assert plan.voxel_of[members].eq(voxel).all()
    assert plan.voxel_of[~valid].eq(-1).all()


@pytest.mark.parametrize("left_out", [0, 12])
def test_gradients_of_values_and_weights(left_out):
    points, batch, values, weights = cloud(50)
    valid = torch.arange(50) >= left_out
    plan = planned(points, batch, valid)
    assert plan.counts.max() > 1
    inputs = (values.requires_grad_(), weights.requires_grad_())
    assert torch.autograd.gradcheck(lambda f, n: pool_mean(f, n, plan), inputs)
    assert torch.autograd.gradcheck(lambda n: pool_min(n, plan), (weights,))


def test_points_on_faces_fall_by_division_and_cells_too_far_apart_are_refused_by_name():
    size = torch.tensor([0.1])
    count = torch.arange(-50, 50, dtype=torch.float64)
    points = torch.stack((count * float(size), count * 0, count * 0), 1)
    cells = point_cells(points, torch.zeros(100, dtype=torch.int64), size)
    assert torch.equal(torch.floor(cells[:, 0]), count)
    with pytest.raises(ValueError, match="increase voxel_size"):
        mixed_radix_keys(torch.tensor([[0, 0, 0], [1 << 21, 1 << 21, 1 << 21]]), torch.tensor([0, 1]))


def test_voxel_size_guard():
    depth = torch.full((2, 1, 4, 4), 2.0)
    depth[1] = 0  # nothing valid: the configured size is used
    intrinsics = torch.diag(torch.tensor([50.0, 50, 1])).expand(2, 1, 3, 3)
    cameras = Cameras(torch.eye(4).expand(2, 1, 4, 4), intrinsics, (4, 4))
    geometry = Geometry(depth, torch.ones_like(depth), cameras, torch.ones(2))
    for options, sizes in (((0.002, 1.5), [0.06, 0.002]), ((0.1, 1.5), [0.1, 0.1]), ((0.002, 0), [0.002, 0.002])):
        torch.testing.assert_close(scene_voxel_size(geometry, *options), torch.tensor(sizes))
