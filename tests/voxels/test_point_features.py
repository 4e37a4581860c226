"""The compiled pass over pixels' features holds to the plain one, in value and gradient."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from vg2gt.method.fine import point_features, pool_point_features
from vg2gt.method.grid import VoxelPlan, plan_voxels, pool_mean

CHANNELS = 20  # no multiple of a vector's length


def points(count: int = 3000, scale: float = 1.0) -> tuple[list[Tensor], VoxelPlan]:
    """Dense features, places, weight and confidences of points in two scenes, a tenth of them in no voxel."""
    generator = torch.Generator().manual_seed(3)
    cells = 6 * torch.rand(count, 3, generator=generator, dtype=torch.float64)
    batch = (torch.arange(count) >= count // 3).long()
    plan = plan_voxels(cells, batch, torch.rand(count, generator=generator) > 0.1)
    dense = scale * torch.randn(count, CHANNELS, generator=generator)
    weight = torch.randn(CHANNELS, 3, generator=generator)
    confidence = 0.1 + torch.rand(count, generator=generator)
    return [dense, (cells - cells.floor() - 0.5).float(), weight, confidence], plan


def plain(dense: Tensor, offset: Tensor, weight: Tensor, confidence: Tensor, plan: VoxelPlan) -> Tensor:
    return pool_mean(point_features(dense, offset, weight), confidence, plan)


def exactly(dense: Tensor, offset: Tensor, weight: Tensor, confidence: Tensor, plan: VoxelPlan) -> Tensor:
    """In double precision; ``point_features`` itself goes to float32."""
    return pool_mean(torch.nn.functional.gelu(dense + offset @ weight.t()), confidence, plan)


def with_gradients(inputs: list[Tensor], plan: VoxelPlan, pool=pool_point_features) -> list[Tensor]:
    """The pooled features and the gradients of a weighted sum of them."""
    leaves = [tensor.clone().requires_grad_() for tensor in inputs]
    pooled = pool(*leaves, plan)
    seen = torch.linspace(-1, 1, pooled.numel(), dtype=pooled.dtype).view_as(pooled)
    (pooled * seen).sum().backward()
    return [pooled.detach(), *(leaf.grad for leaf in leaves if leaf.grad is not None)]


@pytest.mark.parametrize("scale", [0.1, 1.0, 30.0])
def test_values_and_gradients_are_the_plain_ones(scale: float) -> None:
    inputs, plan = points(scale=scale)
    assert 0 < int((plan.voxel_of < 0).sum()) < 600
    compiled = with_gradients(inputs, plan)
    exact = with_gradients([tensor.double() for tensor in inputs], plan, exactly)
    assert len(compiled) == len(exact) == 5
    for found, wanted in zip(compiled, exact, strict=True):
        assert float((found - wanted).abs().max()) < 2e-6 * float(wanted.abs().max().clamp(min=1))


def test_threads_do_not_change_a_bit() -> None:
    inputs, plan = points()
    threads, results = torch.get_num_threads(), []
    for number in (1, 2, 3, threads):
        torch.set_num_threads(number)
        results.append(with_gradients(inputs, plan))
    assert all(torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other, strict=True))


def test_points_in_no_voxel_have_no_gradient_and_no_say() -> None:
    inputs, plan = points()
    left_out = plan.voxel_of < 0
    before = with_gradients(inputs, plan)
    changed = [inputs[0].clone(), *inputs[1:]]
    changed[0][left_out] = 1e6
    after = with_gradients(changed, plan)
    assert torch.equal(before[0], after[0])
    for gradient in (after[1], after[2], after[4]):
        assert not gradient[left_out].any()
        assert gradient[~left_out].any()


def test_nan_reaches_its_voxel_and_no_other() -> None:
    """Training finds faults by what is not finite."""
    inputs, plan = points()
    row = int(plan.order[plan.starts[5]])
    inputs[0][row, 3] = torch.nan
    pooled, of_dense, _, of_weight, of_confidence = with_gradients(inputs, plan)
    hit = pooled.isnan()
    assert hit[5, 3]
    assert int(hit.sum()) == 1
    assert of_dense[row, 3].isnan()
    assert of_weight[3].isnan().all()
    assert of_confidence[row].isnan()


def test_dropped_voxels_are_left_out() -> None:
    inputs, plan = points()
    keep = torch.arange(len(plan)) % 3 > 0
    compiled = with_gradients(inputs, plan.select(keep))
    expected = with_gradients(inputs, plan.select(keep), plain)
    torch.testing.assert_close(compiled, expected, atol=2e-5, rtol=1e-5)
