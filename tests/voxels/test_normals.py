"""Normals of voxels against surfaces that are known."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.voxels import normals
from vg2gt.voxels.grid import VoxelPlan, plan_voxels, pool_mean
from vg2gt.voxels.normals import surface_normals

UP = torch.tensor([0.1, -0.2, 1.0])
FLOOR = torch.tensor([0.0, 0.0, 1.0])


def moments_of(points: Tensor, batch: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor, VoxelPlan]:
    """Spread, direction to a camera far up, mean positions and cells of points ``[N, 3]`` (cells)."""
    batch = torch.zeros(len(points), dtype=torch.int64) if batch is None else batch
    plan = plan_voxels(points.double(), batch, torch.ones(len(points), dtype=torch.bool))
    inside = points - points.floor() - 0.5
    weights = torch.ones(len(points))
    offset = pool_mean(inside, weights, plan)
    squares = pool_mean((inside[:, :, None] * inside[:, None]).flatten(1), weights, plan).unflatten(1, (3, 3))
    spread = squares - offset[:, :, None] * offset[:, None]
    return spread, F.normalize(UP, dim=0).expand(len(plan), 3), offset, plan


def layers(normal: Tensor, apart: float, seed: int = 0) -> Tensor:
    """Points of a plane over 20 x 20 cells as three views saw it, ``apart`` cells of each other."""
    generator = torch.Generator().manual_seed(seed)
    place = 20 * torch.rand(3, 4000, 2, generator=generator)
    height = -(place * normal[:2]).sum(-1) / normal[2] + apart * torch.tensor([[-1.0], [0.0], [1.0]])
    return torch.cat((place, height[..., None]), -1).flatten(0, 1) + 0.3


def error(found: Tensor, normal: Tensor) -> Tensor:
    """Angles ``[M]`` between normals and the true one, in degrees."""
    return torch.rad2deg((found @ F.normalize(normal, dim=0)).clamp(-1, 1).acos())


@pytest.mark.parametrize("normal", [(0.3, -0.2, 1.0), (-0.6, 0.5, 1.0)])
def test_layers_of_several_views_make_one_surface(normal: tuple[float, ...]) -> None:
    truth = torch.tensor(normal)
    parts = moments_of(layers(truth, apart=0.3))
    own, around = (error(surface_normals(*parts, kernel), truth).mean() for kernel in (1, 3))
    assert own > 12, own
    assert around < 0.35 * own, (own, around)


def test_a_cell_alone_keeps_its_own_normal() -> None:
    truth = torch.tensor([0.2, 0.4, 1.0])
    points = layers(truth, apart=0.0)
    cells = points.floor().long()
    parts = moments_of(points[(cells % 3 == 0).all(1)])  # no two of these cells touch
    own, around = surface_normals(*parts, 1), surface_normals(*parts, 3)
    torch.testing.assert_close(around, own, atol=1e-3, rtol=0)
    assert float(error(own, truth).median()) < 1


def test_a_step_of_the_floor_stays_a_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is 1.5 cells high; a plane through all points beside it leans."""
    points = layers(FLOOR, apart=0.0)
    points[:, 2] += 1.5 * (points[:, 0] > 10)
    parts = moments_of(points)
    cell = parts[-1].grid[:, 0]
    beside = (cell == 9) | (cell == 10)
    wrong = error(surface_normals(*parts, 3), FLOOR)[beside].mean()
    monkeypatch.setattr(normals, "SAME_SURFACE", 100.0)
    leaning = error(surface_normals(*parts, 3), FLOOR)[beside].mean()
    assert wrong < 12 < 0.5 * leaning, (wrong, leaning)


def test_scenes_are_apart() -> None:
    first, second = (layers(torch.tensor(n), 0.3, seed) for seed, n in enumerate([(0.3, 0.1, 1.0), (-0.5, 0.4, 1.0)]))
    batch = torch.arange(2).repeat_interleave(len(first))
    both = surface_normals(*moments_of(torch.cat((first, second)), batch), 3)
    alone = [surface_normals(*moments_of(points), 3) for points in (first, second)]
    torch.testing.assert_close(both, torch.cat(alone))


def test_nothing_and_one_point() -> None:
    assert surface_normals(*moments_of(torch.zeros(0, 3)), 3).shape == (0, 3)
    spread, facing, offset, plan = moments_of(torch.tensor([[5.2, 3.1, 0.4]]))
    torch.testing.assert_close(surface_normals(spread, facing, offset, plan, 3), facing)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
def test_compiled_sums_equal_the_plain_ones(dtype: torch.dtype, tolerance: float) -> None:
    """Two scenes, with cells of several points and of one."""
    points = torch.cat([layers(torch.tensor([0.3, 0.1, 1.0]), 0.3, seed)[: 3000 + seed] for seed in range(2)])
    batch = torch.arange(2).repeat_interleave(torch.tensor([3000, 3001]))
    spread, facing, offset, plan = moments_of(points, batch)
    upper, facing, offset = (v.to(dtype) for v in (spread[:, normals.UPPER[0], normals.UPPER[1]], facing, offset))
    found = normals.sums_compiled(upper, facing, offset, plan)
    expected = normals.sums_reference(upper, facing, offset, plan)
    torch.testing.assert_close(found, expected, rtol=tolerance, atol=tolerance * float(plan.counts.max()))
    assert (expected[:, 0] > plan.counts).any()
