"""Which views each view is checked against."""

import math

import torch

from tests.visibility.test_counts import INTRINSICS, SIZE, sideways
from vg2gt.method.additions.visibility import choose_partners
from vg2gt.types import Cameras


def ring(views: int, radius: float = 2.0) -> Cameras:
    """Cameras around the origin that look at it."""
    poses = torch.eye(4).repeat(views, 1, 1)
    for view in range(views):
        angle = 2 * math.pi * view / views
        turn = torch.tensor([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
        poses[view, :3, :3] = turn
        poses[view, 2, 3] = radius
    return Cameras(poses[None], INTRINSICS.expand(1, views, 3, 3), SIZE)


def test_few_views_are_all_partners_but_themselves() -> None:
    partners = choose_partners(torch.full((4, *SIZE), 2.0), ring(4), 24)
    assert [sorted(row) for row in partners.tolist()] == [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]


def test_of_many_views_the_nearest_and_some_from_the_other_side() -> None:
    chosen = choose_partners(torch.full((40, *SIZE), 2.0), ring(40), 8)
    assert chosen.shape == (40, 8)
    for view, row in enumerate(chosen.tolist()):
        assert view not in row
        assert len(set(row)) == 8
        apart = [min((other - view) % 40, (view - other) % 40) for other in row]
        assert {1, 2} <= set(apart)
        assert max(apart) > 10


def test_views_that_look_elsewhere_are_no_partners() -> None:
    cameras = sideways(0, 0.1, 50)
    partners = choose_partners(torch.full((3, *SIZE), 2.0), cameras, 2)
    assert partners.tolist() == [[1, -1], [0, -1], [-1, -1]]
