"""Which views each view is checked against."""

import math

import torch

from tests.visibility.test_counts import SIZE, cameras, sideways
from vg2gt.geometry.cameras import rigid_motions
from vg2gt.types import Cameras
from vg2gt.visibility import choose_partners


def ring(views: int) -> Cameras:
    """Cameras around the origin that look at it from 2 away."""
    angle = torch.arange(views) * 2 * math.pi / views
    poses = rigid_motions(torch.stack((0 * angle, angle, 0 * angle), -1), torch.tensor([0, 0, 2.0]).repeat(views, 1))
    return cameras(poses)


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
    partners = choose_partners(torch.full((3, *SIZE), 2.0), sideways(0, 0.1, 50), 2)
    assert partners.tolist() == [[1, -1], [0, -1], [-1, -1]]
