import logging
from dataclasses import replace

import pytest
import torch

from vg2gt.geometry.cameras import camera_centers, scale_translations, unproject
from vg2gt.method.additions.point_moments import pool_point_moments
from vg2gt.method.grid import plan_voxels, pool_mean


def test_voxels_hold_the_weighted_means_of_their_pixels(make_fine, make_room):
    tokens, geometry, images = make_room(scenes=2)
    voxels = make_fine()(tokens, geometry, images)
    assert torch.equal(voxels.batch, voxels.batch.sort().values)
    points = unproject(geometry.depth, geometry.cameras)
    for scene in (0, 1):
        rows = voxels.batch == scene
        cells = torch.floor(points[scene].double().reshape(-1, 3) / 0.125).long()
        cell, members = cells.unique(dim=0, return_inverse=True)
        assert torch.equal(voxels.grid[rows], cell)
        weight = geometry.depth_conf[scene].flatten().double()
        total = torch.zeros(len(cell), dtype=torch.float64).index_add_(0, members, weight)
        for ours, values in (
            (voxels.centroid[rows], points[scene].reshape(-1, 3)),
            (voxels.colors[rows], images[scene].permute(0, 2, 3, 1).reshape(-1, 3)),
        ):
            mean = torch.zeros(len(cell), 3, dtype=torch.float64).index_add_(0, members, values * weight[:, None])
            torch.testing.assert_close(ours.double(), mean / total[:, None], atol=1e-5, rtol=1e-5)
        least = torch.full_like(total, 1e9).scatter_reduce_(0, members, weight, "amin")
        assert torch.equal(voxels.confidence[rows].double(), least)
        assert torch.equal(voxels.count[rows].long(), torch.bincount(members))
    half = voxels.voxel_size[voxels.batch, None] / 2
    assert ((voxels.centroid - voxels.centers).abs() <= half * (1 + 1e-5)).all()


def test_gradients_reach_tokens_depth_confidence_and_every_parameter(make_fine, make_room):
    tokens, geometry, images = make_room()
    inputs = [*tokens.patch, geometry.depth, geometry.depth_conf]
    for x in inputs:
        x.requires_grad_()
    module = make_fine()
    voxels = module(tokens, geometry, images)
    (voxels.features.square().sum() + voxels.centroid.sum()).backward()
    for x in (*inputs, *module.parameters()):
        assert torch.isfinite(x.grad).all()
        assert x.grad.abs().sum() > 0


def test_sky_and_non_finite_pixels_are_left_out(make_fine, make_room):
    tokens, geometry, images = make_room()
    depth = geometry.depth
    depth[0, 0, :20] = 0
    depth[0, 1, :10], depth[0, 2, :10] = torch.nan, torch.inf
    geometry.depth_conf[0, 1, 10:12] = torch.nan
    depth[0, 0, 30, 30] = 1e9  # too far to be numbered
    depth.requires_grad_()
    module = make_fine()
    voxels = module(tokens, geometry, images)
    assert int(voxels.count.sum()) == 3 * 42 * 84 - 20 * 84 - 10 * 84 - 10 * 84 - 2 * 84 - 1
    for values in (voxels.features, voxels.colors, voxels.centroid, voxels.confidence):
        assert torch.isfinite(values).all()
    (voxels.features.sum() + voxels.centroid.sum()).backward()
    assert torch.isfinite(depth.grad).all()
    assert depth.grad[0, 0, :20].eq(0).all()
    assert all(torch.isfinite(p.grad).all() for p in module.parameters() if p.grad is not None)


@pytest.mark.parametrize("moments", [False, True])
def test_a_scene_without_points_has_no_voxels(make_fine, make_room, moments):
    tokens, geometry, images = make_room(scenes=2)
    module = make_fine(moments=moments)
    geometry.depth[0] = 0
    assert module(tokens, geometry, images).batch.unique().tolist() == [1]
    nothing = module(tokens, replace(geometry, depth=geometry.depth * 0), images)
    assert nothing.features.shape == (0, module.out_channels)
    nothing.features.sum().backward()


def test_scaling_scene_and_voxel_by_a_power_of_two(make_fine, make_room):
    tokens, geometry, images = make_room()
    cameras = scale_translations(geometry.cameras, torch.tensor([4.0]))
    small = make_fine()(tokens, geometry, images)
    large = make_fine(voxel_size=0.5)(tokens, replace(geometry, depth=geometry.depth * 4, cameras=cameras), images)
    assert torch.equal(small.grid, large.grid)
    assert torch.equal(small.features, large.features)
    torch.testing.assert_close(4 * small.centroid, large.centroid)
    torch.testing.assert_close(4 * small.voxel_size, large.voxel_size)


def test_cap_keeps_the_most_confident_and_says_so(make_fine, make_room, caplog):
    inputs = make_room(scenes=2)
    everything = make_fine()(*inputs)
    with caplog.at_level(logging.WARNING, logger="vg2gt.method.fine"):
        capped = make_fine(max_voxels=50)(*inputs)
    assert "max_voxels=50" in caplog.text
    assert torch.bincount(capped.batch).tolist() == [50, 50]
    for scene in (0, 1):
        best = everything.confidence[everything.batch == scene].sort(descending=True).values[:50]
        assert torch.equal(capped.confidence[capped.batch == scene].sort(descending=True).values, best)
    caplog.clear()
    make_fine(max_voxels=10**6)(*inputs)
    assert not caplog.text


def test_without_gradient_views_are_pooled_a_few_at_a_time_to_the_same_voxels(make_fine, make_room):
    tokens, geometry, images = make_room(scenes=2, views=3)
    geometry.depth[0, 1, :20] = 0  # pixels that no voxel uses
    module = make_fine(moments=True)
    whole = module(tokens, geometry, images)
    seen = []
    decode = module.dense_head._decode
    module.dense_head._decode = lambda *args: seen.append(len(args[2])) or decode(*args)
    module.dense_head.views_per_chunk = 2
    with torch.no_grad():
        chunked = module(tokens, geometry, images)
    assert seen == [2, 2, 2]
    assert torch.equal(chunked.grid, whole.grid)
    torch.testing.assert_close(chunked.features, whole.features, atol=1e-5, rtol=1e-5)
    for found, expected in zip(vars(chunked.moments).values(), vars(whole.moments).values(), strict=True):
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)


def test_moments_are_the_covariances_of_the_pixels(make_fine, make_room):
    tokens, geometry, images = make_room(scenes=2)
    module = make_fine(moments=True)
    module.dense_head.views_per_chunk = 4  # of six
    voxels = module(tokens, geometry, images)
    points = unproject(geometry.depth, geometry.cameras)
    focal = geometry.cameras.intrinsics[0, 0, 0, 0]
    for scene in (0, 1):
        rows = (voxels.batch == scene).nonzero()[:, 0]
        cells = torch.floor(points[scene].double().reshape(-1, 3) / 0.125).long()
        for row in rows[:: len(rows) // 20].tolist():
            inside = (cells == voxels.grid[row]).all(-1)
            weight = geometry.depth_conf[scene].flatten()[inside].double()
            place = points[scene].reshape(-1, 3)[inside].double() / 0.125
            color = images[scene].permute(0, 2, 3, 1).reshape(-1, 3)[inside].double()
            share = (weight / weight.sum())[:, None]
            place, color = place - (share * place).sum(0), color - (share * color).sum(0)
            spread, cross = (share * place).T @ place, (share * place).T @ color
            torch.testing.assert_close(voxels.moments.spread[row].double(), spread, atol=2e-6, rtol=1e-4)
            torch.testing.assert_close(voxels.moments.cross[row].double(), cross, atol=2e-6, rtol=1e-4)
            depth = geometry.depth[scene].flatten()[inside].double()
            torch.testing.assert_close(voxels.moments.pixel[row].double(), (share[:, 0] * depth).sum() / focal / 0.125)
            sight = voxels.centroid[row] - camera_centers(geometry.cameras)[scene].mean(0)
            assert (voxels.moments.facing[row] * sight).sum() < 0


def test_compiled_moments_equal_the_reference():
    cells = torch.randint(0, 6, (600, 3))
    plan = plan_voxels(cells, torch.zeros(600, dtype=torch.long), torch.rand(600) > 0.1)
    values, depth, confidence, views = torch.rand(600, 6) - 0.5, torch.rand(600) + 1, torch.rand(600), torch.rand(3, 4)
    inputs = [values, depth, confidence, views + 0.5, pool_mean(values, confidence, plan)]
    compiled = pool_point_moments(*inputs, plan, views_per_chunk=2)
    reference = pool_point_moments(*(tensor.double() for tensor in inputs), plan, views_per_chunk=2)
    assert (compiled.dtype, reference.dtype) == (torch.float32, torch.float64)
    torch.testing.assert_close(compiled.double(), reference, atol=1e-6, rtol=1e-5)


def test_fringes_of_silhouettes_make_no_voxels(make_fine, make_room):
    tokens, geometry, images = make_room(views=1)
    geometry.depth[..., :40], geometry.depth[..., 42:] = 1.0, 2.0
    geometry.depth[..., 40:42] = torch.tensor([1.3, 1.7])
    kept = make_fine()(tokens, geometry, images)
    clean = make_fine(drop_fringes=True)(tokens, geometry, images)
    assert int(kept.count.sum()) - int(clean.count.sum()) == 2 * 42

    def between(voxels):
        z = (voxels.centroid @ geometry.cameras.world_to_camera[0, 0, :3, :3].T)[:, 2]
        return int(((z > 1.2) & (z < 1.8)).sum())

    assert between(kept) > 0
    assert between(clean) == 0


def test_voxels_of_large_views_cover_as_much_as_those_of_smaller_ones(make_fine, make_room):
    tokens, geometry, images = make_room(scenes=1)
    longer = max(geometry.cameras.size)
    plain = make_fine(min_footprint=6.0)(tokens, geometry, images).voxel_size
    half = make_fine(min_footprint=6.0, footprint_view=longer // 2)(tokens, geometry, images).voxel_size
    torch.testing.assert_close(half, plain * longer / (longer // 2))
    for enough in (longer, 10 * longer):  # smaller views have no smaller voxels
        same = make_fine(min_footprint=6.0, footprint_view=enough)(tokens, geometry, images).voxel_size
        torch.testing.assert_close(same, plain)
    with pytest.raises(ValueError, match=r"model\.fine\.footprint_view must be at least 1, or null, got 0"):
        make_fine(footprint_view=0)


def test_training_draws_voxel_sizes_and_inference_does_not(make_fine, make_room):
    tokens, geometry, images = make_room(scenes=2)
    module = make_fine(min_footprint=6.0, coarsest_drawn=3.0)
    torch.manual_seed(0)
    coarsen = torch.tensor([1.0, 2.0])
    plain = module.eval()(tokens, geometry, images, coarsen).voxel_size
    module.train()
    factors = torch.stack([module(tokens, geometry, images, coarsen).voxel_size / plain for _ in range(8)])
    assert 1 <= factors.min() < 1.5
    assert 2 < factors.max() <= 3
    assert (factors[:, 0] != factors[:, 1]).all()
    with pytest.raises(ValueError, match=r"model\.fine\.coarsest_drawn must be at least 1, got 0.5"):
        make_fine(coarsest_drawn=0.5)
