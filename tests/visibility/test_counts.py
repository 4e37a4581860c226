"""Counts of agreeing and contradicting views, compiled and in plain torch."""

import pytest
import torch
from torch import Tensor

from vg2gt.geometry.cameras import rigid_motions
from vg2gt.types import Cameras, Geometry
from vg2gt.visibility import ViewCheck, check, choose_partners, count_views
from vg2gt.visibility.counts import count_views_reference

SIZE = (20, 28)
INTRINSICS = torch.tensor([[25.0, 0.0, 13.5], [0.0, 25.0, 9.5], [0.0, 0.0, 1.0]])


def cameras(poses: Tensor) -> Cameras:
    return Cameras(poses[None], INTRINSICS.expand(1, len(poses), 3, 3), SIZE)


def sideways(*shifts: float) -> Cameras:
    """Cameras that look the same way from places side by side."""
    poses = torch.eye(4).repeat(len(shifts), 1, 1)
    poses[:, 0, 3] = -torch.tensor(shifts)
    return cameras(poses)


def everyone(views: int) -> Tensor:
    return torch.stack([torch.tensor([j for j in range(views) if j != i]) for i in range(views)])


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_compiled_pass_equals_the_reference(seed: int, weighted: bool) -> None:
    random = torch.Generator().manual_seed(seed)
    views = 6
    depth = 2 + 0.3 * torch.rand(views, *SIZE, generator=random)
    depth[torch.rand(depth.shape, generator=random) < 0.1] = 0
    turns, shifts = (scale * torch.randn(views, 3, generator=random) for scale in (0.1, 0.2))
    several = cameras(rigid_motions(turns, shifts))
    partners = choose_partners(depth, several, 4)
    partners[0, -1] = -1
    found = count_views(depth, several, partners, 0.03, 0.05, weighted)
    expected = count_views_reference(depth.double(), several.map(Tensor.double), partners, 0.03, 0.05, weighted)
    for name in ("agree", "through", "hidden"):
        total = getattr(expected, name)
        assert total.mean() > 0.05, name
        # a point on the border of a pixel or of a tolerance may fall on either side in float32
        assert ((getattr(found, name) - total).abs() < 1e-4).double().mean() > 0.999, name


def test_a_plane_agrees_where_it_is_seen_and_views_without_depth_say_nothing() -> None:
    depth = torch.full((3, *SIZE), 2.0)
    counts = count_views(depth, sideways(0, 0.1, 0.2), everyone(3), 0.02, 0.04)
    assert counts.through.max() == 0
    assert counts.hidden.max() == 0
    assert (counts.agree[:, :, 5:-5] == 2).all()
    assert (counts.agree[0, :, 0] == 0).all()  # to the left of what the others see
    depth[1:] = 0
    counts = count_views(depth, sideways(0, 0.1, 0.2), everyone(3), 0.02, 0.04)
    assert max(total.max() for total in (counts.agree, counts.through, counts.hidden)) == 0


def test_what_hangs_in_front_is_looked_through_and_what_lies_behind_is_hidden() -> None:
    depth = torch.full((3, *SIZE), 2.0)
    depth[0, 8:12, 10:16] = 1.0
    depth[1, 2:6, 10:16] = 4.0
    counts = count_views(depth, sideways(0, 0.02, 0.04), everyone(3), 0.02, 0.04)
    assert (counts.through[0, 8:12, 10:16] == 2).all()
    assert (counts.agree[0, 8:12, 10:16] == 0).all()
    assert (counts.hidden[1, 3:5, 11:15] == 2).all()
    assert (counts.through[1, 3:5, 11:15] == 0).all()


def test_the_weight_of_a_view_is_the_ratio_of_distances_and_at_most_two() -> None:
    poses = torch.eye(4).repeat(4, 1, 1)
    poses[1:, 2, 3] = torch.tensor([-1.6, -1.0, 2.0])  # .4 and 1 unit from the plane, which is 2 away, and 4 units
    depth = 2 + poses[:, 2, 3, None, None].expand(4, *SIZE)
    counts = count_views(depth.contiguous(), cameras(poses), everyone(4), 0.02, 0.04, weighted=True)
    middle = (slice(9, 11), slice(13, 15))
    assert torch.allclose(counts.agree[0][middle], torch.tensor(2 + 2 + 2 / 4))
    assert torch.allclose(counts.agree[3][middle], torch.tensor(2.0 + 2 + 2))
    assert counts.through.max() == 0


def test_of_many_views_a_near_one_outweighs_two_far_ones(monkeypatch) -> None:
    poses = torch.eye(4).repeat(4, 1, 1)
    poses[1:, 2, 3] = torch.tensor([-1.0, 2.0, 2.0])
    depth = torch.tensor([2.0, 1.0, 9.0, 9.0])[:, None, None].repeat(1, *SIZE)  # the last two look through the plane
    geometry = Geometry(depth[None], torch.ones_like(depth)[None], cameras(poses), torch.ones(1))
    middle = (0, 0, slice(9, 11), slice(13, 15))
    assert not ViewCheck(rounds=1)(geometry).keep[middle].any()
    monkeypatch.setattr(check, "MANY", 3)
    assert ViewCheck(rounds=1)(geometry).keep[middle].all()
