"""Normals of voxels against surfaces that are known."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.types import VoxelMoments
from vg2gt.voxels.grid import VoxelPlan, plan_voxels, pool_mean
from vg2gt.voxels.normals import with_normals

UP = torch.tensor([0.1, -0.2, 1.0])


def moments_of(points: Tensor, batch: Tensor | None = None) -> tuple[VoxelMoments, Tensor, VoxelPlan]:
    """Moments, mean positions and cells of points ``[N, 3]`` (cells) that a camera far up sees."""
    batch = torch.zeros(len(points), dtype=torch.int64) if batch is None else batch
    plan = plan_voxels(points.double(), batch, torch.ones(len(points), dtype=torch.bool))
    inside = points - points.floor() - 0.5
    weights = torch.ones(len(points))
    offset = pool_mean(inside, weights, plan)
    squares = pool_mean((inside[:, :, None] * inside[:, None]).flatten(1), weights, plan).unflatten(1, (3, 3))
    spread = squares - offset[:, :, None] * offset[:, None]
    facing = F.normalize(UP, dim=0).expand(len(plan), 3)
    empty = torch.zeros(len(plan), 3, 3)
    return VoxelMoments(spread, empty, facing, torch.zeros(len(plan))), offset, plan


def layers(normal: Tensor, apart: float, seed: int = 0) -> Tensor:
    """Points of a plane over 20 x 20 cells as three views saw it, ``apart`` cells of each other."""
    generator = torch.Generator().manual_seed(seed)
    place = 20 * torch.rand(3, 4000, 2, generator=generator)
    height = -(place * normal[:2]).sum(-1) / normal[2] + apart * torch.tensor([[-1.0], [0.0], [1.0]])
    return torch.cat((place, height[..., None]), -1).flatten(0, 1) + 0.3


def error(found: VoxelMoments, normal: Tensor) -> Tensor:
    """Angles ``[M]`` between normals and the true one, in degrees."""
    assert found.normal is not None
    return torch.rad2deg((found.normal @ F.normalize(normal, dim=0)).clamp(-1, 1).acos())


@pytest.mark.parametrize("normal", [(0.3, -0.2, 1.0), (-0.6, 0.5, 1.0)])
def test_layers_of_several_views_make_one_surface(normal: tuple[float, ...]) -> None:
    truth = torch.tensor(normal)
    parts = moments_of(layers(truth, apart=0.3))
    own, around = (error(with_normals(*parts, kernel), truth).mean() for kernel in (1, 3))
    assert own > 12, own
    assert around < 0.35 * own, (own, around)


def test_a_cell_alone_keeps_its_own_normal() -> None:
    truth = torch.tensor([0.2, 0.4, 1.0])
    points = layers(truth, apart=0.0)
    cells = points.floor().long()
    parts = moments_of(points[(cells % 3 == 0).all(1)])  # no two of these cells touch
    own, around = with_normals(*parts, 1), with_normals(*parts, 3)
    assert own.normal is not None
    torch.testing.assert_close(around.normal, own.normal, atol=1e-3, rtol=0)
    assert float(error(own, truth).median()) < 1


def test_an_edge_between_two_planes_stays() -> None:
    """A floor and a step of it, 1.5 cells up: beyond the edge's own cells both keep the floor's normal."""
    floor = torch.tensor([0.0, 0.0, 1.0])
    points = layers(floor, apart=0.0)
    points[:, 2] += 1.5 * (points[:, 0] > 10)
    moments, offset, plan = moments_of(points)
    beside = (plan.grid[:, 0] == 9) | (plan.grid[:, 0] == 10)
    wrong = error(with_normals(moments, offset, plan, 3), floor)[beside]
    assert wrong.mean() < 12, wrong.mean()  # a plane through all points beside the edge leans by some 40 degrees


def test_scenes_are_apart() -> None:
    first, second = (layers(torch.tensor(n), 0.3, seed) for seed, n in enumerate([(0.3, 0.1, 1.0), (-0.5, 0.4, 1.0)]))
    batch = torch.arange(2).repeat_interleave(len(first))
    both = with_normals(*moments_of(torch.cat((first, second)), batch), 3)
    alone = [with_normals(*moments_of(points), 3) for points in (first, second)]
    assert both.normal is not None
    parts = [part.normal for part in alone if part.normal is not None]
    torch.testing.assert_close(both.normal, torch.cat(parts))
    assert len(parts) == 2


def test_nothing_and_one_point() -> None:
    nothing = with_normals(*moments_of(torch.zeros(0, 3)), 3)
    assert nothing.normal is not None
    assert nothing.normal.shape == (0, 3)
    one = with_normals(*moments_of(torch.tensor([[5.2, 3.1, 0.4]])), 3)
    torch.testing.assert_close(one.normal, one.facing)
