"""The check in blocks is the check of all views at once."""

import pytest
import torch

from tests.voxels.conftest import room
from vg2gt.visibility import ViewCheck
from vg2gt.visibility import check as check_module
from vg2gt.visibility.check import _neighbourhood, choose_partners


@pytest.mark.parametrize("many", [100, 5])
def test_blocks_keep_the_same_pixels(many: int, monkeypatch) -> None:
    monkeypatch.setattr(check_module, "MANY", many)
    _, geometry, _ = room(views=7)
    depth = geometry.depth.clone()
    depth[0, ::2, 5:15, 10:30] *= 0.7  # hangs in the air
    depth[0, 1, :4] = 0
    check = ViewCheck(partners=3)
    whole = check(type(geometry)(depth, geometry.depth_conf, geometry.cameras, geometry.scale))
    partners = choose_partners(depth[0], geometry.cameras, check.partners)
    masks = (torch.zeros_like(depth[0]), torch.zeros_like(depth[0]))
    blocks = [slice(0, 2), slice(2, 5), slice(5, 7)]
    steps = list(check.in_blocks(depth[0], geometry.cameras, partners, blocks, masks))
    assert len(steps) == check.rounds * len(blocks)
    assert torch.equal(masks[0] > 0, whole.keep[0])
    assert 0 < (masks[0] > 0).float().mean() < 1
    assert torch.equal(check.coarsening(depth[0], geometry.cameras, partners), whole.coarsen[0])


def test_a_neighbourhood_counts_partners_among_its_views() -> None:
    partners = torch.tensor([[1, 2], [0, -1], [3, 1], [2, 0]])
    views, local = _neighbourhood(partners, torch.tensor([2, 3]))
    assert views.tolist() == [2, 3, 0, 1]
    assert local.tolist() == [[1, 3], [0, 2], [-1, -1], [-1, -1]]


def test_of_many_views_those_beyond_a_wall_are_no_partners(monkeypatch) -> None:
    _, geometry, _ = room(views=6)
    depth = geometry.depth[0].clone()
    depth[4:] *= 0.3  # a wall in front of what these look at
    before = choose_partners(depth, geometry.cameras, 2)
    assert torch.isin(torch.tensor([4, 5]), before[:4]).any()
    monkeypatch.setattr(check_module, "MANY", 5)
    partners = choose_partners(depth, geometry.cameras, 2)
    assert partners.shape == (6, 5)  # four times as many
    assert not torch.isin(torch.tensor([4, 5]), partners[:4]).any()
