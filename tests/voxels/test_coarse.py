from dataclasses import replace

import pytest
import torch

from vg2gt.method.coarse import PatchPoints


def perturb(module, seed=0):
    """Gives the zero-initialised projections weight, as training would."""
    torch.manual_seed(seed)
    for branch in module.zero:
        torch.nn.init.normal_(branch.weight, std=0.1)
    return module


@pytest.mark.parametrize(("inject", "changed"), [("all", [True, True]), ("last", [False, True])])
def test_injection_changes_the_chosen_taps_once_trained_and_never_the_camera(inject, changed, make_coarse, make_room):
    tokens, geometry, _ = make_room(scenes=2)
    module = make_coarse(inject=inject)
    for expected in ([False, False], changed):
        out = module(tokens, geometry)
        assert [not torch.equal(a, b) for a, b in zip(out.patch, tokens.patch, strict=True)] == expected
        assert out.camera is tokens.camera
        perturb(module)


def test_last_layer_learns_at_step_one_and_ptv3_from_step_two_and_geometry_is_detached(make_coarse, make_room):
    tokens, geometry, _ = make_room()
    geometry.depth.requires_grad_()
    geometry.depth_conf.requires_grad_()
    module = make_coarse()
    optimizer = torch.optim.SGD(module.parameters(), lr=0.1)
    target = [torch.randn_like(tap) for tap in tokens.patch]
    norms = []
    for _ in range(2):
        out = module(tokens, geometry)
        torch.stack([(a - b).square().mean() for a, b in zip(out.patch, target, strict=True)]).sum().backward()
        last = sum(branch.weight.grad.abs().sum() for branch in module.zero)
        inner = sum(p.grad.abs().sum() for p in module.ptv3.parameters())
        norms.append((float(last), float(inner)))
        optimizer.step()
        optimizer.zero_grad()
    assert norms[0][0] > 0 == norms[0][1] < norms[1][1]
    assert geometry.depth.grad is geometry.depth_conf.grad is None


def test_points_are_nearest_pixels_with_the_least_confidence(make_room):
    _, geometry, _ = make_room()
    points = PatchPoints(geometry, 7, torch.tensor([0.125]))
    depth = geometry.depth[0, :, 3::7, 3::7].flatten()
    assert len(points.rows) == len(depth)
    confidence = geometry.depth_conf[0].unfold(1, 7, 7).unfold(2, 7, 7).amin((-1, -2))
    assert torch.equal(points.confidence, confidence.flatten())
    # back in its own camera, a point has the sampled pixel's depth
    poses = geometry.cameras.world_to_camera[0].repeat_interleave(6 * 12, 0)
    local = (poses[:, :3, :3] @ (points.cells.float() * 0.125)[..., None])[..., 0] + poses[:, :3, 3]
    torch.testing.assert_close(local[:, 2], depth, atol=1e-5, rtol=1e-5)
    pixel = local[:, :2] / local[:, 2:] * geometry.cameras.intrinsics[0, 0, 0, 0]
    pixel = (pixel + geometry.cameras.intrinsics[0, 0, :2, 2]).view(3, 6, 12, 2)
    torch.testing.assert_close(pixel[0, :, 0, 1], 3.0 + 7 * torch.arange(6), atol=1e-3, rtol=0)
    torch.testing.assert_close(pixel[1, 0, :, 0], 3.0 + 7 * torch.arange(12), atol=1e-3, rtol=0)


def test_patches_without_points_keep_their_tokens(make_coarse, make_room):
    tokens, geometry, _ = make_room(scenes=2)
    geometry.depth[0, 1, :14, :14] = 0
    geometry.depth[0, 1, 14:28, :14] = torch.nan
    geometry.depth[1] = 0  # a scene without any point
    out = perturb(make_coarse())(tokens, geometry)
    for before, after in zip(tokens.patch, out.patch, strict=True):
        same = (before == after).all(-1)
        assert same[0, 1].nonzero()[:, 0].tolist() == [0, 6]
        assert same[1].all()
        assert torch.isfinite(after).all()


def test_nothing_valid_keeps_every_parameter_in_the_graph(make_coarse, make_room):
    tokens, geometry, _ = make_room()
    module = perturb(make_coarse())
    out = module(tokens, replace(geometry, depth=torch.zeros_like(geometry.depth)))
    assert all(torch.equal(a, b) for a, b in zip(out.patch, tokens.patch, strict=True))
    torch.cat(out.patch).sum().backward()
    assert all(p.grad is not None and p.grad.eq(0).all() for p in module.parameters())


def test_scenes_do_not_influence_each_other(make_coarse, make_room):
    tokens, geometry, _ = make_room(scenes=2)
    module = perturb(make_coarse()).eval()
    both = module(tokens, geometry)
    for rows in (slice(0, 1), slice(1, 2)):
        out = module(*(record.map(lambda t, rows=rows: t[rows]) for record in (tokens, geometry)))
        for a, b in zip(out.patch, both.patch, strict=True):
            torch.testing.assert_close(a, b[rows], atol=1e-5, rtol=1e-5)
