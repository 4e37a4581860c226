import math
from dataclasses import replace

import pytest
import torch
from torch import nn

from vg2gt.geometry.rotations import quat_to_matrix
from vg2gt.method import GaussianHead
from vg2gt.method.additions.surfel import surfel_start
from vg2gt.types import VoxelMoments, Voxels


def wall(rows=8, columns=8, channels=16, size=0.5, scenes=1, seed=0):
    """Voxels on the plane z = 0 with random features and colours."""
    generator = torch.Generator().manual_seed(seed)
    cells = torch.cartesian_prod(torch.arange(rows), torch.arange(columns), torch.tensor([0]))
    grid = cells.repeat(scenes, 1)
    count = len(grid)
    centers = (grid + 0.5) * size
    return Voxels(
        features=torch.randn(count, channels, generator=generator),
        colors=torch.rand(count, 3, generator=generator),
        grid=grid,
        batch=torch.arange(scenes).repeat_interleave(len(cells)),
        confidence=torch.ones(count),
        count=torch.ones(count),
        centroid=centers + (torch.rand(count, 3, generator=generator) - 0.5) * size,
        voxel_size=torch.full((scenes,), size),
    )


def head(seed=0, **options):
    torch.manual_seed(seed)
    return GaussianHead(16, **options)


@pytest.mark.parametrize("splits", [1, 2, 4])
@pytest.mark.parametrize("degree", [0, 2])
@pytest.mark.parametrize("anchor", ["centroid", "center"])
def test_parameters_stay_within_their_bounds(splits, degree, anchor):
    voxels = wall(scenes=2)
    module = head(splits=splits, sh_degree=degree, anchor=anchor, max_offset=0.7)
    nn.init.normal_(module.out.weight, std=0.5)  # far from the start
    g = module(voxels)
    assert len(g) == splits * len(voxels.grid)
    assert g.sh.shape == (len(g), (degree + 1) ** 2, 3)
    assert torch.equal(g.batch, voxels.batch.repeat_interleave(splits))
    v = 0.5
    assert ((g.scales > 0) & (g.scales < 2 * v)).all()
    origin = voxels.centroid if anchor == "centroid" else voxels.centers
    assert ((g.means - origin.repeat_interleave(splits, 0)).abs() <= 0.7 * v * (1 + 1e-5)).all()
    torch.testing.assert_close(g.quats.norm(dim=-1), torch.ones(len(g)))
    assert ((g.opacities >= 0) & (g.opacities <= 1)).all()


@pytest.mark.parametrize("splits", [1, 2, 4])
def test_untrained_gaussians_are_coloured_blobs_of_half_a_voxel(splits):
    voxels = wall()
    module = head(splits=splits, sh_degree=2)
    nn.init.zeros_(module.out.weight)
    g = module(voxels)
    colors = 0.5 + 0.28209479177387814 * g.sh[:, 0]
    torch.testing.assert_close(colors, voxels.colors.repeat_interleave(splits, 0))
    assert g.sh[:, 1:].eq(0).all()
    torch.testing.assert_close(g.scales, torch.full_like(g.scales, 0.25))
    torch.testing.assert_close(g.means, voxels.centroid.repeat_interleave(splits, 0))
    torch.testing.assert_close(g.quats, torch.tensor([1.0, 0, 0, 0]).expand_as(g.quats))
    joint = 1 - (1 - g.opacities.view(-1, splits)).prod(1)
    torch.testing.assert_close(joint, torch.full_like(joint, 0.95))


def test_slots_start_apart():
    """Slots of equal weights would get equal gradients and never separate."""
    first, second = head().out.weight.view(2, 14, -1)
    assert (first - second).abs().min(0).values.max() > 0


def test_scaling_voxels_scales_means_and_scales():
    module = head(sh_degree=1)
    small, large = module(wall(size=0.5)), module(wall(size=2.0))
    torch.testing.assert_close(4 * small.means, large.means)
    torch.testing.assert_close(4 * small.scales, large.scales)
    for name in ("quats", "opacities", "sh"):
        assert torch.equal(getattr(small, name), getattr(large, name))


def test_gradients_reach_every_parameter_and_the_anchor():
    voxels = wall()
    voxels.centroid.requires_grad_()
    module = head(sh_degree=1)
    g = module(voxels)
    outputs = torch.cat([x.flatten() for x in (g.means, g.scales, g.quats, g.sh, g.opacities)])
    (outputs * torch.linspace(0, 1, len(outputs))).sum().backward()
    assert voxels.centroid.grad is not None
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in module.parameters())
    assert math.isfinite(module.opacity_bias)


@pytest.mark.parametrize("options", [{"splits": 0}, {"sh_degree": 4}, {"anchor": "middle"}])
def test_bad_options_are_refused_by_name(options):
    with pytest.raises(ValueError, match=rf"gaussians\.{next(iter(options))}"):
        head(**options)


def surfel_wall(**options):
    """The wall's voxels with points all over their cells in its plane, seen from in front."""
    voxels = wall(**options)
    count = len(voxels.grid)
    spread = torch.diag(torch.tensor([1.0, 1.0, 0.0]) / 12).expand(count, 3, 3)
    cross = torch.zeros(count, 3, 3)
    cross[:, 1] = 0.02 * torch.arange(1, 4)
    facing = torch.tensor([0.0, 0.0, -1.0]).expand(count, 3)
    return replace(voxels, moments=VoxelMoments(spread, cross, facing, torch.full((count,), 0.1), facing))


@pytest.mark.parametrize("splits", [1, 2, 3, 4])
@pytest.mark.parametrize("anchor", ["centroid", "center"])
@pytest.mark.parametrize("degree", [0, 3])
def test_a_head_that_says_nothing_gives_the_surfels(splits, anchor, degree):
    voxels = surfel_wall()
    module = head(splits=splits, anchor=anchor, sh_degree=degree, start="surfel")
    nn.init.zeros_(module.out.weight)
    g, start = module(voxels), surfel_start(voxels.moments, splits)
    torch.testing.assert_close(g.means, (voxels.centroid[:, None] + 0.5 * start.offsets).flatten(0, 1))
    torch.testing.assert_close(g.scales, (0.5 * start.scales).flatten(0, 1))
    frames = quat_to_matrix(g.quats).unflatten(0, (-1, splits))
    torch.testing.assert_close(frames, start.frame[:, None].expand_as(frames), atol=1e-5, rtol=1e-5)
    colors = (voxels.colors[:, None] + start.colors).clamp(0, 1).flatten(0, 1)
    torch.testing.assert_close(0.5 + 0.28209479177387814 * g.sh[:, 0], colors)
    torch.testing.assert_close(g.opacities, torch.full((len(g),), 0.88))


def test_what_the_head_says_is_a_residual_in_the_surface_frame():
    voxels = surfel_wall()
    module = head(splits=1, start="surfel", max_offset=0.5)
    nn.init.zeros_(module.out.weight)
    before = module(voxels)
    with torch.no_grad():
        module.out.bias[2] = 0.3  # along the third axis: the normal
    shift = (module(voxels).means - before.means) / 0.5
    normal = surfel_start(voxels.moments, 1).frame[:, :, 2]
    torch.testing.assert_close(shift, 0.5 * torch.tanh(torch.tensor(0.3)) * normal, atol=1e-6, rtol=1e-5)


def test_the_surfel_start_needs_moments():
    with pytest.raises(ValueError, match=r"start=surfel requires model\.fine\.moments=true"):
        head(start="surfel")(wall())
    with pytest.raises(ValueError, match=r"gaussians\.start is 'surfels'; choose one of plain, surfel"):
        head(start="surfels")
