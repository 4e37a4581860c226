"""Second moments of points hold to their definition."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from vg2gt.method.additions.point_moments import Moments, pool_point_moments
from vg2gt.method.grid import VoxelPlan, plan_voxels, pool_mean

VIEWS = 7
CHUNK = 3  # of the views


def points(per_view: int = 431) -> tuple[list[Tensor], VoxelPlan]:
    """Values, depths, confidences and views of points in two scenes, a tenth of them in no voxel, and their plan."""
    generator = torch.Generator().manual_seed(5)
    count = VIEWS * per_view
    cells = 6 * torch.rand(count, 3, generator=generator, dtype=torch.float64)
    batch = (torch.arange(count) >= 3 * per_view).long()
    plan = plan_voxels(cells, batch, torch.rand(count, generator=generator) > 0.1)
    values = torch.cat(((cells - cells.floor() - 0.5).float(), torch.rand(count, 3, generator=generator)), -1)
    depth, confidence = 0.5 + torch.rand(2, count, generator=generator)
    views = torch.cat((torch.randn(VIEWS, 3, generator=generator), 1 + torch.rand(VIEWS, 1, generator=generator)), -1)
    return [values, depth, confidence, views], plan


def pooled(inputs: list[Tensor], plan: VoxelPlan) -> Moments:
    values, depth, confidence, views = inputs
    return pool_point_moments(values, depth, confidence, views, pool_mean(values, confidence, plan), plan, CHUNK)


def by_definition(inputs: list[Tensor], plan: VoxelPlan) -> Moments:
    """Voxel by voxel in float64."""
    values, depth, confidence, views = (tensor.double() for tensor in inputs)
    view = torch.arange(len(values)) // (len(values) // len(views))
    rows = []
    for voxel in range(len(plan)):
        mine = (plan.voxel_of == voxel).nonzero()[:, 0]
        share = (confidence[mine] / confidence[mine].sum())[:, None]
        apart = values[mine] - (share * values[mine]).sum(0)
        both = (share * apart).T @ apart
        seen = views[view[mine]]
        side = (share[:, 0] * depth[mine] / seen[:, 3]).sum()
        rows.append((both[:3, :3], both[:3, 3:], (share * seen[:, :3]).sum(0), side))
    spread, cross, eye, pixel = (torch.stack(parts) for parts in zip(*rows, strict=True))
    return spread, cross, eye, pixel


def test_moments_are_those_of_the_definition() -> None:
    inputs, plan = points()
    assert 0 < int((plan.voxel_of < 0).sum()) < 600
    assert int(plan.counts.min()) == 1
    for found, exact in zip(pooled(inputs, plan), by_definition(inputs, plan), strict=True):
        assert float((found - exact).abs().max()) < 1e-6


@pytest.mark.parametrize("per_view", [1, 3, 49, 1000])
def test_every_point_has_its_own_view(per_view: int) -> None:
    """Each point a voxel of its own: nothing spreads, and the mean camera is the one that saw it."""
    (_, depth, confidence, views), _ = points(per_view)
    count = VIEWS * per_view
    cells = torch.arange(count)[:, None].expand(count, 3) + 0.25
    plan = plan_voxels(cells.double(), torch.zeros(count, dtype=torch.int64), torch.ones(count, dtype=torch.bool))
    inputs = [torch.rand(count, 6), depth, confidence, views]
    spread, cross, eye, pixel = pooled(inputs, plan)
    seen = views.repeat_interleave(per_view, 0)
    torch.testing.assert_close(eye, seen[:, :3])
    torch.testing.assert_close(pixel, depth / seen[:, 3])
    assert not spread.abs().max() > 1e-12
    assert not cross.abs().max() > 1e-6


def test_points_in_no_voxel_have_no_say() -> None:
    inputs, plan = points()
    before, left_out = pooled(inputs, plan), plan.voxel_of < 0
    inputs = [tensor.clone() for tensor in inputs]
    for tensor in inputs[:3]:
        tensor[left_out] = torch.nan
    assert all(torch.equal(a, b) for a, b in zip(before, pooled(inputs, plan), strict=True))


# place, colour, depth, confidence
@pytest.mark.parametrize(("part", "column", "numbers"), [(0, 1, 5 + 3), (0, 5, 3), (1, 0, 1), (2, 0, 9 + 9 + 3 + 1)])
def test_nan_reaches_its_voxel_and_no_other(part, column, numbers):
    """Training finds faults by what is not finite."""
    inputs, plan = points()
    before, voxel = pooled(inputs, plan), 8
    inputs[part].view(len(plan.voxel_of), -1)[plan.order[plan.starts[voxel]], column] = torch.nan
    after = pooled(inputs, plan)
    others = torch.arange(len(plan)) != voxel
    assert all(torch.equal(a[others], b[others]) for a, b in zip(before, after, strict=True))
    assert sum(int(tensor[voxel].isnan().sum()) for tensor in after) == numbers
