"""Nothing around what masks cut out; scenes behind what masks hide stay."""

import math

import pytest
import torch

from vg2gt.geometry.cameras import ray_directions, unproject
from vg2gt.geometry.spherical_harmonics import rgb_to_sh
from vg2gt.method.additions.far_shell import COUNT
from vg2gt.method.additions.hull import meaning_of, outside_hull
from vg2gt.reconstruction.scene import Scene
from vg2gt.reconstruction.surroundings import with_surroundings
from vg2gt.rendering import Renderer
from vg2gt.types import Cameras, Gaussians

SIZE, VIEWS = (48, 64), 10


def orbit() -> Cameras:
    """Cameras at a distance of 4 around the origin that look at it."""
    poses = torch.eye(4).repeat(VIEWS, 1, 1)
    for view in range(VIEWS):
        angle = 2 * math.pi * view / VIEWS
        rows = [[math.cos(angle), 0.0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
        poses[view, :3, :3] = torch.tensor(rows)
        poses[view, 2, 3] = 4
    k = torch.tensor([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]])
    return Cameras(poses[None], k.expand(1, VIEWS, 3, 3), SIZE)


def ball(cameras: Cameras) -> torch.Tensor:
    """Depth ``[V, H, W]`` of a ball of radius 1."""
    rays = ray_directions(cameras.intrinsics[0], SIZE)
    a, b = rays.square().sum(-1), -4 * rays[..., 2]
    root = b.square() - a * 15
    return torch.where(root > 0, (-b - root.clamp(min=0).sqrt()) / a, 0.0)


def room(cameras: Cameras) -> torch.Tensor:
    """Depth of the cylinder of radius 6 around the cameras."""
    rays = ray_directions(cameras.intrinsics[0], SIZE)
    a = rays[..., 0].square() + rays[..., 2].square()
    return (4 * rays[..., 2] + ((4 * rays[..., 2]).square() + a * 20).sqrt()) / a


def scene_of(depth: torch.Tensor, mask: torch.Tensor, cameras: Cameras, debris: torch.Tensor) -> Scene:
    points = unproject(depth[None], cameras)[0][depth > 0]
    means = torch.cat((points, debris))
    count = len(means)
    gaussians = Gaussians(
        means,
        torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        torch.full((count, 3), 0.05),
        torch.full((count,), 0.9),
        rgb_to_sh(torch.full((count, 3), 0.5))[:, None],
        torch.zeros(count, dtype=torch.int64),
    )
    names = tuple(map(str, range(VIEWS)))
    images = torch.full((VIEWS, 3, *SIZE), 0.5)
    return Scene(gaussians, cameras, images, depth, torch.ones_like(depth), names, Renderer(), mask=mask)


def test_a_cut_out_stands_on_nothing() -> None:
    cameras = orbit()
    depth = ball(cameras)
    mask = (depth > 0).float()
    depth[:, 20:28, 28:36] = 0  # not found: a shell filled such pixels, and all around
    behind = unproject(2 * depth[None], cameras)[0][depth > 0]  # debris, within the mask of its own view
    made = with_surroundings(scene_of(depth, mask, cameras, behind))
    kept = made.gaussians.means.norm(dim=1)
    assert len(kept) == pytest.approx(int((depth > 0).sum()), abs=0.03 * int((depth > 0).sum()))
    assert kept.max() < 1.5
    assert not outside_hull(made.gaussians.means, cameras, mask, 0.0).any()
    assert torch.equal(made.depth > 0, depth > 0)


def test_depth_outside_of_the_masks_is_no_depth() -> None:
    cameras = orbit()
    depth = ball(cameras)
    mask = (depth > 0).float()
    wrong = depth.clone()
    wrong[0] *= 2
    made = with_surroundings(scene_of(wrong, mask, cameras, torch.zeros(0, 3)))
    assert (made.depth[0] > 0).float().mean() < 0.2 * (depth[0] > 0).float().mean()
    assert torch.equal(made.depth[1:], depth[1:])


@pytest.mark.parametrize("kind", ["transient", "vignette", "operator"])
def test_a_scene_goes_on_behind_what_masks_hide(kind: str) -> None:
    cameras = orbit()
    mask = torch.ones(VIEWS, *SIZE)
    for view in range(VIEWS):
        if kind == "transient":  # somebody walks through
            mask[view, 10:, (view * 17) % 50 : (view * 17) % 50 + 14] = 0
        elif kind == "operator":
            mask[view, 38:, 10:54] = 0
        else:
            y, x = torch.meshgrid(torch.arange(48) - 23.5, torch.arange(64) - 31.5, indexing="ij")
            mask[view] = (x.square() + y.square() < 24**2).float()
    depth = room(cameras) * mask
    depth[:, :4] = 0
    scene = scene_of(depth, mask, cameras, torch.zeros(0, 3))
    made = with_surroundings(scene)
    assert torch.equal(made.gaussians.means[:-COUNT], scene.gaussians.means)  # and a shell
    assert torch.equal(made.depth, depth)


def test_a_masked_sky_has_no_shell_before_it() -> None:
    cameras = orbit()
    mask = torch.ones(VIEWS, *SIZE)
    mask[:, :24] = 0
    depth = room(cameras) * mask
    depth[:, 40:] = 0
    above = torch.tensor([[0.0, -2.0, 0.0]])  # y is down
    scene = scene_of(depth, mask, cameras, above)
    assert meaning_of(depth, cameras, mask).is_object is False
    made = with_surroundings(scene)
    far = made.gaussians.means[int((depth > 0).sum()) :]
    assert 100 < len(far) < COUNT
    assert not outside_hull(far, cameras, mask, 0.0).any()
