"""Depth that other views confirm keeps the backbone's value."""

import math

import pytest
import torch

from tests.visibility.test_check import wall
from vg2gt.visibility import ViewCheck, keep_agreed


def test_confirmed_depth_stays_and_the_rest_is_enhanced_by_its_share() -> None:
    initial = wall(4)
    initial.depth[0, 0, 6:20, 8:26] = 1.0  # the others look through it, so it is not confirmed
    mixed = keep_agreed(initial, torch.full_like(initial.depth, 3.0), ViewCheck())[0]
    assert torch.allclose(mixed[0, :1, 4:], torch.tensor(2.0))
    share = 14 * 18 / initial.depth.numel()  # of the scene
    part = mixed[0, 11:20, 13:21].log() / math.log(3)
    assert part.min().item() == pytest.approx(share, rel=0.2)
    assert part.max() - part.min() < 1e-5
    edge = mixed[0, 6, 13:21]  # about half of the pixels around are confirmed
    assert (edge < mixed[0, 15, 17]).all()
    assert (edge > 1).all()


def test_a_single_view_confirms_nothing_and_missing_depth_stays_missing() -> None:
    initial = wall(1)
    initial.depth[0, 0, 0] = 0
    enhanced = torch.full_like(initial.depth, 3.0)
    enhanced[0, 0, 1] = 0
    torch.testing.assert_close(keep_agreed(initial, enhanced, ViewCheck()), enhanced)


def test_gradient_reaches_the_enhanced_part_only_where_it_counts() -> None:
    initial = wall(4)
    initial.depth[0, 0, 6:20, 8:26] = 1.0
    enhanced = torch.full_like(initial.depth, 3.0).requires_grad_()
    initial.depth.requires_grad_()
    keep_agreed(initial, enhanced, ViewCheck()).sum().backward()
    assert enhanced.grad is not None
    assert initial.depth.grad is None
    assert (enhanced.grad[0, 0, 11:20, 13:21] > 0.01).all()
    assert enhanced.grad[0, 0, :1, 4:].abs().max() < 1e-6


def test_scenes_of_a_batch_do_not_confirm_each_other() -> None:
    one, other = wall(3), wall(3)
    other.depth[0, 0, 6:20, 8:26] = 1.0
    both = one.map(lambda tensor: torch.cat((tensor, tensor)))
    both.depth[1] = other.depth[0]
    enhanced = torch.full_like(both.depth, 3.0)
    mixed = keep_agreed(both, enhanced, ViewCheck())
    for scene, alone in enumerate((one, other)):
        assert torch.equal(mixed[scene], keep_agreed(alone, enhanced[:1], ViewCheck())[0])
