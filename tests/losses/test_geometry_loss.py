"""VGGT's terms against straightforward re-derivations on point maps."""

from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.gpu_counts import Waits, as_on_a_gpu
from vg2gt.geometry.cameras import scale_translations, unproject
from vg2gt.geometry.rotations import quat_to_matrix
from vg2gt.losses import GeometryLoss
from vg2gt.losses.geometry import (
    depth_gradient_loss,
    order_statistic,
    point_normal_loss,
    point_normal_reference,
    sorted_order_statistic,
    trusted_pixels,
)
from vg2gt.losses.truth import normalize_truth
from vg2gt.types import Cameras


def disturbed(sample, size=(24, 32), seed=3, scenes=1):
    """A sample's truth, and predicted depth, confidence and cameras that differ from it, in the truth's unit."""
    made = sample(size=size, scenes=scenes)
    generator = torch.Generator().manual_seed(seed)
    truth = normalize_truth(made.batch).views(slice(0, 3))
    noise = torch.randn(truth.depth.shape, generator=generator, dtype=torch.float64)
    depth = truth.depth * (1 + 0.05 * noise)
    poses = truth.cameras.world_to_camera.clone()
    turn = torch.tensor([1, 0.02, -0.03, 0.01], dtype=torch.float64)
    poses[:, 1:, :3, :3] = quat_to_matrix(turn) @ poses[:, 1:, :3, :3]
    poses[:, 1:, :3, 3] += 0.05
    intrinsics = truth.cameras.intrinsics.clone()
    intrinsics[..., 0, 0] *= 1.03
    cameras = Cameras(poses, intrinsics, size)
    valid = torch.rand(depth.shape, generator=generator) > 0.15
    conf = 1 + torch.rand(depth.shape, generator=generator, dtype=torch.float64)
    return truth, depth, conf, cameras, valid


def slow_mean_terms(error: Tensor, conf: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    e, c = error[valid], conf[valid]
    if len(e) > 1000:
        keep = e <= torch.quantile(e, 0.98)
        e, c = e[keep], c[keep]
    return (c * e - 0.2 * torch.log(c)).mean(), e.mean()


def slow_depth_gradient(error: Tensor, valid: Tensor) -> Tensor:
    scales = []
    for stride in (1, 2, 4, 8):
        e, m = error[:, ::stride, ::stride], valid[:, ::stride, ::stride]
        steps = [e.diff(dim=dim).abs().clamp(max=100)[m.unfold(dim, 2, 1).all(-1)].sum() for dim in (1, 2)]
        scales.append(sum(steps) / m.sum())
    return torch.stack(scales).mean()


def slow_point_normals(points: Tensor, true_points: Tensor, valid: Tensor) -> Tensor:
    scales = []
    for stride in (1, 2, 4):
        p, q, m = (x[:, ::stride, ::stride] for x in (points, true_points, valid))
        values = []
        for v, y, x in m.nonzero().tolist():
            for yy, xx in ((y + 1, x + 1), (y + 1, x - 1), (y - 1, x + 1), (y - 1, x - 1)):
                if 0 <= yy < m.shape[1] and 0 <= xx < m.shape[2] and m[v, y, xx] and m[v, yy, x]:
                    normals = (torch.linalg.cross(c[v, y, xx] - c[v, y, x], c[v, yy, x] - c[v, y, x]) for c in (p, q))
                    values.append(1 - torch.cosine_similarity(*normals, dim=0))
        scales.append(torch.stack(values).mean())
    return torch.stack(scales).mean()


def test_tasks_match_their_definitions_on_depth_and_point_maps(sample) -> None:
    truth, depth, conf, cameras, valid = disturbed(sample, size=(18, 20))
    task, of_points = GeometryLoss()(depth, conf, cameras, truth, valid)
    error = depth[0] - truth.depth[0]
    expected = *slow_mean_terms(error.abs(), conf[0], valid[0]), slow_depth_gradient(error, valid[0])
    torch.testing.assert_close((task[0].conf, task[0].reg, task[0].grad), expected)
    torch.testing.assert_close(task[0].total, sum(expected))
    points, true_points = unproject(depth, cameras)[0], unproject(truth.depth, truth.cameras)[0]
    error = (points - true_points).norm(dim=-1)
    expected = *slow_mean_terms(error, conf[0], valid[0]), slow_point_normals(points, true_points, valid[0])
    torch.testing.assert_close((of_points[0].conf, of_points[0].reg, of_points[0].grad), expected)


@pytest.mark.parametrize("on_gpu", [False, True])
def test_scenes_and_predictions_together_equal_each_alone(sample, on_gpu: bool) -> None:
    """In value and gradient; scenes have different numbers of valid pixels."""
    truth, depth, conf, cameras, valid = disturbed(sample, size=(26, 40), scenes=2)
    valid[1, :, 9:] = False
    both = cameras.map(lambda tensor: torch.stack((tensor, tensor)))
    maps = torch.stack((depth, depth * 1.1)), torch.stack((conf, conf + 1))
    together, alone = ([values.clone().requires_grad_() for values in maps] for _ in range(2))
    with as_on_a_gpu() if on_gpu else nullcontext():
        found = GeometryLoss()(*together, both, truth, valid)
        each = [
            [GeometryLoss()(*(x[p, b : b + 1] for x in alone), cameras.scene(b), truth.map(lambda t, b=b: t[b : b + 1]),
                            valid[b : b + 1]) for b in range(2)]
            for p in range(2)
        ]  # fmt: skip
    for task in range(2):
        for part in ("conf", "reg", "grad"):
            values = torch.stack([torch.cat([getattr(scene[task], part) for scene in one]) for one in each])
            torch.testing.assert_close(getattr(found[task], part), values, rtol=1e-12, atol=1e-14)
    (found[0].total.sum() + found[1].total.sum()).backward()
    torch.cat([task.total for one in each for scene in one for task in scene]).sum().backward()
    for one, other in zip(together, alone, strict=True):
        torch.testing.assert_close(one.grad, other.grad, rtol=1e-9, atol=1e-14)


def test_one_set_of_pixels_is_kept_below_the_quantile() -> None:
    error = torch.rand(3, 30, 40, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    valid = torch.rand(error.shape, generator=torch.Generator().manual_seed(1)) > 0.3
    for quantile in (0.5, 0.98, 1.0):
        keep = trusted_pixels(error, valid, quantile)
        assert torch.equal(keep, valid & (error <= torch.quantile(error[valid], quantile)))
    few = valid & (torch.arange(40) < 10)
    assert int(few.sum()) <= 1000
    assert torch.equal(trusted_pixels(error, few, 0.5), few)


def test_a_gpu_sorts_for_the_same_order_statistic_without_a_wait() -> None:
    values = torch.rand(5000, generator=torch.Generator().manual_seed(0))
    values[3000:] = torch.inf
    for count in (0, 1, 2, 2999, 3000):
        for quantile in (0.5, 0.98, 1.0):
            with Waits() as waits:
                found = sorted_order_statistic(values, torch.tensor(count), quantile)
            assert torch.equal(found, order_statistic(values, torch.tensor(count), quantile))
            assert waits.places.total() == 0


def test_an_outlier_has_no_gradient_and_errors_stop_at_100(sample) -> None:
    truth, depth, conf, cameras, _ = disturbed(sample)
    everywhere = torch.ones_like(depth, dtype=torch.bool)
    depth = depth.clone()
    depth[0, 1, 5, 5] = 1e6
    depth.requires_grad_()
    task, point = GeometryLoss()(depth, conf, cameras, truth, everywhere)
    (task.reg + task.conf + point.reg + point.conf).backward()
    assert depth.grad[0, 1, 5, 5] == 0
    assert depth.grad[0, 1, 5, 6] != 0
    assert float(depth_gradient_loss(depth[0].detach() - truth.depth[0], everywhere[0])) < 2
    far, _ = GeometryLoss(quantile=1.0)(truth.depth + 500, torch.ones_like(conf), cameras, truth, everywhere)
    torch.testing.assert_close(torch.cat((far.reg, far.conf)), torch.full((2,), 100.0, dtype=torch.float64))


def test_holes_and_infinities_outside_the_mask_leave_gradients_finite(sample) -> None:
    truth, depth, conf, cameras, valid = disturbed(sample)
    depth, conf = depth.clone(), conf.clone()
    bad = torch.tensor([0.0, torch.inf, -1.0, torch.nan], dtype=torch.float64)
    depth[~valid] = bad.repeat(1000)[: int((~valid).sum())]
    conf[~valid] = 0
    depth.requires_grad_()
    conf.requires_grad_()
    task, point = GeometryLoss()(depth, conf, cameras, truth, valid)
    (task.total + point.total).backward()
    assert torch.isfinite(task.total + point.total)
    assert torch.isfinite(depth.grad).all()
    assert torch.isfinite(conf.grad).all()
    assert (depth.grad[~valid] == 0).all()


def test_fewer_than_100_pixels_give_a_zero_with_graph(sample) -> None:
    made = sample()
    few = torch.zeros_like(made.batch.depth)
    few[0, 1, 3, :] = 3.0
    few[0, 2, :3, :22] = 3.0  # 32 + 66 = 98 pixels in context views
    few[0, 3] = 3.0  # a held-out view does not count
    truth = normalize_truth(replace(made.batch, depth=few))
    assert not truth.known[0]
    assert truth.unit[0] == 1
    context = truth.views(slice(0, 3))
    depth = made.prediction.geometry.depth.clone().requires_grad_()
    task, point = GeometryLoss()(depth, made.prediction.geometry.depth_conf, context.cameras, context, context.valid)
    (task.total + point.total).backward()
    assert float(task.total.detach()) == float(point.total.detach()) == 0
    assert (depth.grad == 0).all()


def test_truth_is_divided_by_the_mean_distance_in_the_first_frame(sample) -> None:
    made = sample(scenes=2)
    depth = made.batch.depth.clone()
    depth[:, :, :5] = 0
    truth = normalize_truth(replace(made.batch, depth=depth))
    batch = made.batch
    for scene in range(2):
        first = batch.cameras.world_to_camera[scene, 0]
        points = unproject(depth[scene : scene + 1, :3], batch.cameras.scene(scene).select(slice(0, 3)))[0]
        local = points @ first[:3, :3].T + first[:3, 3]
        mask = depth[scene, :3] > 0
        expected = local[mask].norm(dim=-1).sum() / (mask.sum() + 1e-3)
        torch.testing.assert_close(truth.unit[scene], expected)
        torch.testing.assert_close(truth.depth[scene, 3][5:], depth[scene, 3][5:] / expected)
    assert torch.equal(truth.cameras.world_to_camera[:, 0], torch.eye(4, dtype=torch.float64).expand(2, 4, 4))
    assert not truth.valid[:, :, :5].any()
    larger = scale_translations(batch.cameras, torch.full((2,), 7.0, dtype=torch.float64))
    again = normalize_truth(replace(batch, depth=depth * 7, cameras=larger))
    torch.testing.assert_close(again.depth, truth.depth, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(again.cameras.world_to_camera, truth.cameras.world_to_camera, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 2e-5)])
def test_compiled_normals_equal_the_plain_ones(sample, dtype: torch.dtype, tolerance: float) -> None:
    """In value and gradient, with holes, at a size that no stride divides."""
    truth, depth, _, cameras, valid = disturbed(sample, size=(25, 31))

    def cast(tensor: Tensor) -> Tensor:
        return tensor.to(dtype) if tensor.is_floating_point() else tensor

    truth, cameras = truth.map(cast), cameras.map(cast)
    found, expected = (depth.to(dtype, copy=True).requires_grad_() for _ in range(2))
    compiled = point_normal_loss(found, cameras, truth, valid)
    plain = point_normal_reference(expected, cameras, truth, valid)
    assert type(compiled.grad_fn) is not type(plain.grad_fn)
    torch.testing.assert_close(compiled, plain, rtol=tolerance, atol=tolerance / 10)
    (3 * compiled).backward()
    (3 * plain).backward()
    assert (found.grad - expected.grad).norm() < tolerance * expected.grad.norm()


def test_normals_give_cameras_a_gradient_where_they_ask_for_one(sample) -> None:
    truth, depth, _, cameras, valid = disturbed(sample)
    poses = cameras.world_to_camera.clone().requires_grad_()
    loss = point_normal_loss(depth, replace(cameras, world_to_camera=poses), truth, valid)
    (gradient,) = torch.autograd.grad(loss, poses)
    assert gradient.any()
