"""The coarse module's additions to the paper, against values computed by hand."""

import math

import pytest
import torch
from torch import Tensor

from tests.voxels.test_coarse import perturb
from vg2gt.method import coarse
from vg2gt.method.additions.surface_evidence import (
    PointFrames,
    cell_centroids,
    disagreement,
    gate,
    vectors_to_surface,
    voxel_evidence,
)
from vg2gt.method.grid import plan_voxels
from vg2gt.types import Cameras, Geometry

TURN = torch.tensor([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])  # world z becomes the camera's -x, world x its z


def plane(slope: float = 0.0, depth: float = 2.0, step: float = 0.0) -> tuple[Tensor, Cameras]:
    """Depth of the plane ``z = depth + slope x`` seen by 5x5 pixels of focal length 10, right of a step in depth."""
    intrinsics = torch.tensor([[10.0, 0, 2], [0, 10, 2], [0, 0, 1]])[None, None]
    u = (torch.arange(5.0) - 2) / 10
    values = (depth / (1 - slope * u)).repeat(5, 1)
    values[:, 4:] *= 1 + step
    poses = torch.eye(4)[None, None].clone()
    poses[..., :3, :3] = TURN
    return values[None, None], Cameras(poses, intrinsics, (5, 5))


def frame(slope: float = 0.0, row: int = 12, step: float = 0.0) -> PointFrames:
    """Of one pixel; 12 is the one on the optical axis, 13 its neighbour to the right, 0 a corner without a normal."""
    return PointFrames(*plane(slope, step=step), torch.tensor([row]))


def measured(frames: PointFrames, local: tuple[float, float, float], voxel_size: float = 0.08) -> list[float]:
    """What is said of a vector that is ``local`` in the camera's axes."""
    to_surface = TURN.T @ torch.tensor(local)
    return frames.in_camera(to_surface[None], torch.tensor([voxel_size]))[0].tolist()


def test_frames_of_a_frontal_plane_and_of_two_views() -> None:
    frames = frame(row=13)
    torch.testing.assert_close(frames.ray, torch.tensor([[0.1, 0, 1]]))
    torch.testing.assert_close(frames.normal, torch.tensor([[0.0, 0, -1]]))
    assert frames.depth.tolist() == [2]
    depth, camera = plane()
    poses = torch.cat((camera.world_to_camera, torch.eye(4)[None, None]), 1)
    both = Cameras(poses, camera.intrinsics.expand(1, 2, 3, 3), camera.size)
    frames = PointFrames(depth.expand(1, 2, 5, 5), both, torch.tensor([24, 25]))
    assert torch.equal(frames.rotation, torch.stack((TURN, torch.eye(3))))


def test_change_of_depth_is_in_units_of_two_percent_along_the_ray_to_the_tangent_plane():
    # half a voxel of 8 cm behind: 4 cm of 2 m are 2 %
    assert measured(frame(), (0.3, 0.1, 0.5)) == pytest.approx([0.3, 0.1, 0.5, 1.0])
    assert measured(frame(), (0.3, 0.1, -0.5)) == pytest.approx([0.3, 0.1, -0.5, -1.0])
    assert measured(frame(), (0, 0, 0.5), voxel_size=0.04)[3] == pytest.approx(0.5)
    # (1, 0, 1/2) lies in the plane z = x / 2: the surface is where the point is
    assert measured(frame(slope=0.5), (1, 0, 0.5))[3] == pytest.approx(0, abs=1e-6)
    # the plane z = x / 2 - 1/4 through a point half a voxel aside: a quarter of a voxel, half a unit, nearer
    assert measured(frame(slope=0.5), (0.5, 0, 0))[3] == pytest.approx(-0.5)
    # the ray t (1/10, 0, 1) meets the plane z = x / 2 + 1/2 at t = 1 / 1.9
    off_axis = frame(slope=0.5, row=13)
    expected = 1 / 1.9 * 0.08 / (float(off_axis.depth) * 0.02)
    assert measured(off_axis, (0, 0, 0.5))[3] == pytest.approx(expected)


def test_voxels_count_by_their_points_squared_confidence() -> None:
    cells = torch.tensor([[-0.75, 0.5, 0.5], [1.25, 0.5, 0.5], [1.75, 0.5, 0.5]], dtype=torch.float64)
    confidence, batch = torch.tensor([2.0, 1, 3]), torch.zeros(3, dtype=torch.int64)
    plan = plan_voxels(cells, batch, torch.ones(3, dtype=torch.bool))
    evidence = voxel_evidence(confidence, plan)
    assert evidence.tolist() == [4, 10]
    # cells -1 and 1, offsets from their centres; of the second one (1 * -1/4 + 3 * 1/4) / 4
    torch.testing.assert_close(cell_centroids(cells, confidence, plan), torch.tensor([[-0.25, 0, 0], [0.125, 0, 0]]))
    centroids = torch.tensor([[-1.0, 0, 0], [1, 0, 0]])
    found = vectors_to_surface(torch.zeros(1, 3), centroids, evidence[None], torch.tensor([[0, 1]]))
    torch.testing.assert_close(found, torch.tensor([[(10 - 4) / 14, 0, 0]]))


def two_views_of_a_plane(farther: float, confidence: float) -> Geometry:
    """A plane at depth 2; the second of two equal views draws it farther by a factor, with another confidence."""
    intrinsics = torch.tensor([[400.0, 0, 41.5], [0, 400, 20.5], [0, 0, 1]]).expand(1, 2, 3, 3)
    depth, trust = torch.full((1, 2, 42, 84), 2.0), torch.ones(1, 2, 42, 84)
    depth[:, 1] *= farther
    trust[:, 1] *= confidence
    return Geometry(depth, trust, Cameras(torch.eye(4).expand(1, 2, 4, 4), intrinsics, (42, 84)), torch.ones(1))


def inputs_of(network: torch.nn.Module) -> list[Tensor]:
    """Collects what a network is given from now on."""
    seen: list[Tensor] = []
    network.register_forward_pre_hook(lambda _, arguments: seen.append(arguments[0].detach()))
    return seen


@pytest.mark.parametrize(("confidence", "changes"), [(1.0, (1.0, -1.0)), (3.0, (1.5, -0.5))])
def test_each_view_is_told_how_far_it_is_from_the_surface_both_agree_on(confidence, changes, make_room, make_coarse):
    """4 % apart, in voxels that hold both: the surface is their mean, weighted by confidence."""
    tokens = make_room(views=2)[0]
    module = make_coarse(voxel_size=0.15)  # 1.95 to 2.10 along the axis
    voxels, points = inputs_of(module.ptv3), inputs_of(module.fuse[0])
    module(tokens, two_views_of_a_plane(1.04, confidence))
    told = points[0][:, 24:29, 1:-1, 1:-1].mean((2, 3))  # [2, 5]: of PTv3's 24 channels on
    assert told[:, 3].tolist() == pytest.approx(changes, abs=0.08)
    # the same as a vector, 2 % of 2 units in voxels of 0.15
    assert told[:, 2].tolist() == pytest.approx([change * 0.04 / 0.15 for change in changes], abs=0.02)
    assert told[:, 4].tolist() == pytest.approx([0, math.log(confidence)], abs=1e-6)
    # the voxels' centroid in the cell, twice: the surface's place between 1.95 and 2.10, from -1 to 1
    surface = 2 + 0.04 * changes[0]
    assert float(voxels[0][:, 14].mean()) == pytest.approx(2 * ((surface - 1.95) / 0.15 - 0.5), abs=0.1)
    assert voxels[0][:, 12:15].abs().amax() <= 1
    assert torch.equal(voxels[0][:, 15], torch.zeros(len(voxels[0])))


# ------------------------------------------------------------------------------------------------- the gate


def test_disagreement_is_a_scenes_median_and_the_gate_its_third_power_and_no_wider_than_one_and_a_half() -> None:
    change = torch.tensor([0.1, -0.5, 0.3, 9.0, -2.0, 1.0])
    usable = torch.tensor([True, True, True, False, True, False])
    found = disagreement(change, usable, torch.tensor([0, 0, 0, 0, 1, 2]), 4)
    torch.testing.assert_close(found, torch.tensor([0.3, 2.0, 0.0, 0.0]))
    torch.testing.assert_close(gate(torch.tensor([0.0, 0.2, 0.4, 3.0])), torch.tensor([0.0, 0.125, 1.0, 1.5]))


def updates(module: coarse.CoarseModule, geometry: Geometry, make_room) -> Tensor:
    """What a module with non-zero weights in its zero projections adds to the last tap, ``[1, 2, P, D]``."""
    tokens = make_room(views=2)[0]
    for parameter in module.zero.parameters():
        torch.nn.init.constant_(parameter, 0.1)
    with torch.no_grad():
        return module.eval()(tokens, geometry).patch[-1] - tokens.patch[-1]


@pytest.mark.parametrize(("apart", "factor"), [(1.0, 0.0), (1.008, 0.125), (1.016, 1.0), (1.04, 1.5)])
def test_what_is_changed_follows_the_views_disagreement(apart: float, factor: float, make_room, make_coarse) -> None:
    """Two planes x % apart: each view is x / 2 % from their mean, in units of 2 %."""
    geometry = two_views_of_a_plane(apart, 1.0)
    free = updates(make_coarse(voxel_size=0.15), geometry, make_room)
    gated = updates(make_coarse(voxel_size=0.15, gate=True), geometry, make_room)
    share = (gated * free).sum() / free.square().sum()
    assert float(share) == pytest.approx(factor, rel=0.35, abs=1e-4)
    torch.testing.assert_close(gated, share * free, atol=1e-4, rtol=1e-3)


def test_beside_a_silhouette_there_is_no_evidence_and_a_gate_needs_some(make_room, make_coarse) -> None:
    """Views that disagree by 4 %; the right half of what they see is twice as far."""
    tokens, geometry = make_room(views=2)[0], two_views_of_a_plane(1.04, 1.0)
    geometry.depth[..., 42:] *= 2
    module = make_coarse(voxel_size=0.15, gate=True)
    told = inputs_of(module.fuse[0])
    module(tokens, geometry)
    evidence = told[0][:, 24:28].abs().amax((0, 1))  # [3, 6 patches of 14 pixels]: the step is between 2 and 3
    assert (evidence[:, 4:] > 0).any() or (evidence[:, :2] > 0).any()
    # of a patch's four points the two next to the step (7 pixels wide, the step's reach is 3) are left out
    points = coarse.PatchPoints(geometry, 7, torch.tensor([0.15]), away_from_silhouettes=True)
    columns = points.rows % 12
    assert set(columns[~points.clear].tolist()) == {5, 6}
    with pytest.raises(ValueError, match=r"coarse\.gate=true.*coarse\.surface_evidence=true"):
        make_coarse(gate=True, surface_evidence=False)


# ------------------------------------------------------------------------------------------- without the additions

PAPER = {"surface_evidence": False, "embedding_skip": False, "fuse_kernel": 1}


def test_the_papers_module_sees_the_papers_inputs(make_room, make_coarse) -> None:
    """Voxels: the pooled features and the least confidence; fusion: what is interpolated from the enhanced voxels."""
    tokens, geometry, _ = make_room()
    module = make_coarse(**PAPER).eval()
    voxels, fused = inputs_of(module.ptv3), inputs_of(module.fuse[0])
    enhanced: list[Tensor] = []
    module.ptv3.register_forward_hook(lambda *arguments: enhanced.append(arguments[-1]))
    module(tokens, geometry)
    points = coarse.PatchPoints(geometry, 7, torch.tensor([0.125]))
    plan = plan_voxels(points.cells, points.batch, torch.ones_like(points.batch, dtype=torch.bool))
    embedded = module._embed(tokens)[points.rows]
    assert voxels[0].shape == (len(plan), 12 + 1)
    for voxel in range(len(plan)):  # eqn voxelfeature, a voxel at a time
        members = plan.voxel_of == voxel
        weights = points.confidence[members, None]
        mean = (weights * embedded[members]).sum(0) / weights.sum()
        torch.testing.assert_close(voxels[0][voxel, :12], mean, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(voxels[0][voxel, 12], weights.min().log())
    assert fused[0].shape == (3, 24, 3, 6)  # 3 views, PTv3's channels and no more, 3 x 6 patches
    distance = torch.cdist(points.cells, plan.grid.double() + 0.5)
    nearest = distance.topk(16, largest=False)
    weights = 1 / (nearest.values.square() + 1e-6)
    read = ((weights / weights.sum(1, keepdim=True))[..., None] * enhanced[0].detach()[nearest.indices]).sum(1)
    patches = read.view(3, 3, 2, 6, 2, 24).mean((2, 4)).permute(0, 3, 1, 2)
    torch.testing.assert_close(fused[0], patches.float(), atol=1e-4, rtol=1e-4)
    assert [tuple(layer.weight.shape[2:]) for layer in (module.fuse[0], module.fuse[2])] == [(1, 1), (1, 1)]


@pytest.mark.parametrize(
    ("option", "value", "voxel_channels", "fused_channels", "kernel"),
    [
        ("surface_evidence", True, 12 + 3 + 1, 24 + 5, 1),
        ("embedding_skip", True, 12 + 1, 24 + 12, 1),
        ("fuse_kernel", 3, 12 + 1, 24, 3),
    ],
)
def test_every_switch_adds_what_it_names(option, value, voxel_channels, fused_channels, kernel, make_room, make_coarse):
    module = make_coarse(**{**PAPER, option: value})
    assert module.ptv3.embedding["stem"]["conv"].weight.shape[-1] == voxel_channels
    assert module.fuse[0].weight.shape[1:] == (fused_channels, kernel, kernel)
    tokens, geometry, _ = make_room()
    assert perturb(module).eval()(tokens, geometry).patch[-1].isfinite().all()


def test_the_skip_is_the_patches_own_embedding(make_room, make_coarse) -> None:
    tokens, geometry, _ = make_room()
    module = make_coarse(**{**PAPER, "embedding_skip": True}).eval()
    fused = inputs_of(module.fuse[0])
    module(tokens, geometry)
    own = module._embed(tokens).view(3, 3, 2, 6, 2, 12).mean((2, 4)).permute(0, 3, 1, 2)
    torch.testing.assert_close(fused[0][:, 24:], own)
