"""The shell behind the scene shows what no view places, by direction."""

import math
from dataclasses import replace

import pytest
import torch

from vg2gt.geometry.rotations import quat_to_matrix
from vg2gt.method.additions.far_shell import COUNT, far_shell, is_far
from vg2gt.rendering import render
from vg2gt.types import Cameras, Gaussians

SIZE = (24, 32)


def ring(views: int = 4) -> Cameras:
    """Cameras in one place that look to all sides."""
    poses = torch.eye(4).repeat(views, 1, 1)
    for view in range(views):
        angle = 2 * math.pi * view / views
        poses[view, 0, 0] = poses[view, 2, 2] = math.cos(angle)
        poses[view, 2, 0] = math.sin(angle)
        poses[view, 0, 2] = -math.sin(angle)
    intrinsics = torch.tensor([[16.0, 0, 15.5], [0, 16, 11.5], [0, 0, 1]])
    return Cameras(poses[None], intrinsics.expand(1, views, 3, 3), SIZE)


@pytest.fixture
def seen() -> tuple[torch.Tensor, torch.Tensor]:
    """Red ahead, green, blue and grey to the sides; a near floor in the lower half, of another colour."""
    colors = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0.5, 0.5]])
    images = colors[:, :, None, None].repeat(1, 1, *SIZE)
    images[:, :, 16:] = torch.tensor([1.0, 1, 0])[:, None, None]
    depth = torch.zeros(4, *SIZE)
    depth[:, 16:] = 2
    return images, depth


def test_every_direction_has_its_colour(seen: tuple[torch.Tensor, torch.Tensor]) -> None:
    images, depth = seen
    shell = far_shell(images, depth, ring())
    assert len(shell) == COUNT
    shown = render(shell, ring()).color[0]
    for view in range(4):
        found = shown[view, :, 4:10, 12:20].mean((1, 2))
        assert (found - images[view, :, 0, 0]).abs().max() < 0.12, view
    assert (render(shell, ring()).alpha > 0.9).float().mean() > 0.95


def test_it_is_far_and_faces_the_cameras(seen: tuple[torch.Tensor, torch.Tensor]) -> None:
    images, depth = seen
    shell = far_shell(images, depth, ring())
    assert torch.allclose(shell.means.norm(dim=-1), torch.tensor(40.0), rtol=1e-4)
    axis = quat_to_matrix(shell.quats)[..., 2]
    assert torch.allclose((axis * shell.means / 40).sum(-1).abs(), torch.ones(COUNT), atol=1e-4)
    assert is_far(shell, depth, ring()).all()
    assert not is_far(replace(shell, means=shell.means / 20), depth, ring()).any()


def test_masked_pixels_leave_no_colour(seen: tuple[torch.Tensor, torch.Tensor]) -> None:
    images, depth = seen
    mask = torch.ones_like(depth)
    mask[0] = 0  # the red ones
    shell = far_shell(images, depth, ring(), mask)
    ahead = shell.sh[shell.means[:, 2] > 30, 0]
    assert (ahead[:, 0] < 0.3).all()  # about a half without red: 0 is mid grey


@pytest.mark.parametrize("missing", ["nothing", "everything"])
def test_no_shell_where_there_is_nothing_to_show_or_no_scale(seen, missing):
    images, depth = seen
    assert far_shell(images, torch.full_like(depth, 2.0 * (missing == "nothing")), ring()) is None


def test_a_scene_keeps_its_degree_and_background(seen: tuple[torch.Tensor, torch.Tensor]) -> None:
    images, depth = seen
    shell = far_shell(images, depth, ring())
    own = shell.select(torch.arange(5))
    own = Gaussians(
        own.means / 20, own.quats, own.scales, own.opacities, torch.zeros(5, 4, 3), own.batch, torch.rand(1, 3)
    )
    both = own.joined(shell)
    assert (len(both), both.sh.shape) == (5 + COUNT, (5 + COUNT, 4, 3))
    assert both.background is own.background
