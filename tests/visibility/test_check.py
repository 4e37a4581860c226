"""Which depth enters the scene."""

import pytest
import torch

from tests.visibility.test_counts import SIZE, sideways
from vg2gt.types import Cameras, Geometry
from vg2gt.visibility import ViewCheck


def geometry(depth: torch.Tensor, cameras: Cameras) -> Geometry:
    return Geometry(depth[None], torch.full_like(depth[None], 10.0), cameras, torch.ones(1))


def wall(views: int) -> Geometry:
    return geometry(torch.full((views, *SIZE), 2.0), sideways(*(0.02 * view for view in range(views))))


def test_good_depth_and_what_a_single_view_sees_stay() -> None:
    assert ViewCheck()(wall(4)).keep.all()
    assert ViewCheck()(wall(1)).keep.all()
    found = wall(3)
    found.depth[0, 0, :, :8] = 50.0  # behind what the others see: not contradicted, not agreed with
    assert ViewCheck()(found).keep[0, 0, :, :6].all()


def test_what_more_views_look_through_than_agree_with_is_dropped() -> None:
    found = wall(4)
    found.depth[0, 0, 8:12, 10:16] = 1.0  # a guess in the air
    keep = ViewCheck()(found).keep[0]
    assert not keep[0, 8:12, 10:16].any()
    assert keep[0, :6].all()
    assert keep[1:, :, 4:-4].all()


def test_what_was_dropped_says_nothing_in_the_next_round() -> None:
    found = wall(3)
    # Views 1 and 2 both guess, far behind the wall and at different depths: each looks through view 0's wall.
    found.depth[0, 1], found.depth[0, 2] = 8.0, 16.0
    found.depth[0, 0, :, :14] = 0
    assert not ViewCheck(rounds=1)(found).keep[0, 0].any()


def test_scenes_are_checked_apart_and_pixels_without_depth_are_never_kept() -> None:
    one, other = wall(3), wall(3)
    other.depth[0, 0, 8:12, 10:16] = 1.0
    one.depth[0, 1, 0] = 0
    one.depth[0, 1, 1] = torch.nan
    cameras = one.cameras.map(lambda tensor: tensor.repeat(2, 1, 1, 1))
    depth, conf = torch.cat((one.depth, other.depth)), torch.cat((one.depth_conf, other.depth_conf))
    keep = ViewCheck()(Geometry(depth, conf, cameras, torch.ones(2))).keep
    assert torch.equal(keep[0], ViewCheck()(one).keep[0])
    assert torch.equal(keep[1], ViewCheck()(other).keep[0])
    assert not keep[0, 1, :2].any()


def test_options_out_of_range_are_named() -> None:
    wrong = {"tolerance": 0.0, "margin": 0.01, "rounds": 0, "partners": 0, "fine_below": 0, "coarsest": 0.5}
    for option, value in (wrong | {"moment": 1, "moved_margin": 0.01}).items():
        with pytest.raises(ValueError, match=rf"model\.visibility\.{option} must be"):
            ViewCheck(**{option: value})  # type: ignore[arg-type]


def test_voxels_are_coarser_where_views_disagree() -> None:
    """Depth of view 1 is 10 % off: 2.5 pixels at a focal length of 25."""
    found = wall(2)
    assert ViewCheck()(found).coarsen.tolist() == [1.0]
    found.depth[0, 1] *= 1.1
    off = (0.1 + (1 - 1 / 1.1)) / 2 * 25
    coarsen = ViewCheck(fine_below=1.4, coarsest=4)(found).coarsen
    assert coarsen.item() == pytest.approx(off / 1.4, rel=0.1)
    assert ViewCheck(fine_below=1.4, coarsest=1.5)(found).coarsen.tolist() == [1.5]
