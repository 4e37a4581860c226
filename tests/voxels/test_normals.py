"""Normals of voxels against surfaces that are known."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.method.additions import voxel_normals as normals
from vg2gt.method.additions.voxel_normals import surface_normals
from vg2gt.method.grid import VoxelPlan, plan_voxels, pool_mean

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


def test_a_step_of_the_floor_stays_a_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is 1.5 cells high; a plane fitted to all points next to it is tilted."""
    points = layers(FLOOR, apart=0.0)
    points[:, 2] += 1.5 * (points[:, 0] > 10)
    parts = moments_of(points)
    cell = parts[-1].grid[:, 0]
    beside = (cell == 9) | (cell == 10)
    wrong = error(surface_normals(*parts, 3), FLOOR)[beside].mean()
    monkeypatch.setattr(normals, "SAME_SURFACE", 100.0)
    leaning = error(surface_normals(*parts, 3), FLOOR)[beside].mean()
    assert wrong < 12 < 0.5 * leaning, (wrong, leaning)


def two_scenes() -> tuple[Tensor, Tensor, Tensor, VoxelPlan]:
    """Cells of several points and of one."""
    points = torch.cat([layers(torch.tensor([0.3, 0.1, 1.0]), 0.3, seed)[: 3000 + seed] for seed in range(2)])
    return moments_of(points, torch.arange(2).repeat_interleave(torch.tensor([3000, 3001])))


@pytest.mark.parametrize("size", [1e-12, 1e-3, 1.0, 1e12])
@pytest.mark.parametrize("values", [(1.0, 2.0, 3.0), (0.0, 1.0, 1.0), (1e-5, 0.08, 0.09), (0.0, 1e-3, 1.0)])
def test_facing_normals_are_eigenvectors(size: float, values: tuple[float, ...]) -> None:
    generator = torch.Generator().manual_seed(1)
    axes = torch.linalg.qr(torch.randn(3000, 3, 3, generator=generator)).Q  # no multiple of a range of voxels
    spread = size * axes @ torch.diag(torch.tensor(values)) @ axes.transpose(1, 2)
    spread = (spread + spread.transpose(1, 2)) / 2  # to the last bit
    facing = F.normalize(torch.randn(3000, 3, generator=generator), dim=-1)
    sight = facing.double()
    prior = normals.FACING_PRIOR * (torch.eye(3) - sight[:, :, None] * sight[:, None])
    expected = torch.linalg.eigh(spread.double() + prior).eigenvectors[..., 0]
    single, double = normals.facing_normals(spread, facing).double(), normals.facing_normals(spread.double(), sight)
    for found, tolerance in ((single, 2e-7), (double, 1e-9)):
        assert torch.linalg.cross(found, expected).norm(dim=-1).max() < tolerance
        assert (found * sight).sum(-1).min() > -1e-7


@pytest.mark.parametrize("values", [(0.0, 0.0, 0.0), (1e6, 1e6, 1e6), (0.0, 0.0, 1e6), (2e6, 2e6, 3e6)])
def test_without_a_single_least_direction_the_normal_faces_the_cameras(values: tuple[float, ...]) -> None:
    """Cells with the prior only, and cells whose spread dwarfs the prior."""
    facing = F.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(2)), dim=-1)
    spread = torch.diag(torch.tensor(values)).expand(50, 3, 3)
    torch.testing.assert_close(normals.facing_normals(spread, facing), facing)


def test_plain_torch_does_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    *inputs, plan = two_scenes()
    keep = torch.arange(len(plan)) % 5 > 0
    inputs, plan = [tensor[keep] for tensor in inputs], plan.select(keep)
    compiled = surface_normals(*inputs, plan, 3)
    exact = surface_normals(*(tensor.double() for tensor in inputs), plan, 3)
    monkeypatch.setattr(normals, "compilable", lambda *_: False)
    plain = surface_normals(*inputs, plan, 3)
    assert exact.dtype == torch.float64
    torch.testing.assert_close(compiled.double(), exact, atol=1e-3, rtol=0)
    torch.testing.assert_close(plain.double(), exact, atol=1e-2, rtol=0)


def test_what_is_not_finite_stays_among_its_neighbours(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its normal faces the cameras, and is no number where their direction is none."""
    spread, facing, offset, plan = two_scenes()
    before = surface_normals(spread, facing, offset, plan, 3)
    spread, facing = spread.clone(), facing.clone()
    spread[50, 0, 1] = spread[50, 1, 0] = torch.nan
    facing[70] = torch.nan
    compiled = surface_normals(spread, facing, offset, plan, 3)
    monkeypatch.setattr(normals, "compilable", lambda *_: False)
    plain = surface_normals(spread, facing, offset, plan, 3)
    torch.testing.assert_close(compiled, plain, equal_nan=True, atol=1e-2, rtol=0)
    assert compiled[70].isnan().all()
    assert torch.equal(compiled[50], facing[50])
    apart = (plan.grid - plan.grid[50]).abs().amax(1) > 1
    apart[70] = False
    assert torch.equal(compiled[apart], before[apart])
    assert int(compiled.isnan().any(1).sum()) == 1
