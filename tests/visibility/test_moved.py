"""What is there at one moment and gone at another."""

from dataclasses import replace

import numpy as np
import torch
from hydra.utils import instantiate

from examples.worlds.moving import SyntheticMovingRoom
from tests.visibility.test_check import geometry, wall
from tests.visibility.test_counts import SIZE, sideways
from vg2gt.config import compose
from vg2gt.types import Cameras, Geometry, Hints
from vg2gt.visibility import ViewCheck

TIME = torch.arange(7)[None]


def leaving(views: int = 7, stays: int = 5) -> tuple[Geometry, torch.Tensor]:
    """A box before a wall in the first views, gone in the others; and its pixels."""
    cameras = sideways(*(0.14 * view / views for view in range(views)))
    depth = torch.full((views, *SIZE), 2.0)
    for view in range(stays):
        depth[view, 8:12, 12:17] = 1.5
    return geometry(depth, cameras), depth[None] < 1.9


def test_what_is_gone_at_another_moment_is_dropped_everywhere() -> None:
    found, box = leaving()
    static = ViewCheck()(found, TIME).keep
    assert static[box].float().mean() > 0.8  # five views agree, two look through
    keep = ViewCheck(moment=2)(found, TIME).keep
    assert not keep[box].any()
    assert keep[~box].all()
    assert ViewCheck(moment=2, moved_margin=0.3)(found, TIME).keep[box].float().mean() > 0.8  # it moves by less


def test_what_stays_is_kept_and_so_is_all_where_nothing_is_known_of_time() -> None:
    assert ViewCheck(moment=2)(wall(7), TIME).keep.all()
    found, _ = leaving()
    assert torch.equal(ViewCheck(moment=2)(found).keep, ViewCheck()(found).keep)
    found, box = leaving(stays=6)  # a single view that looks through is no moment
    assert ViewCheck(moment=2)(found, TIME).keep[box].float().mean() > 0.8


def test_moments_are_longer_where_each_view_is_compared_with_few_others() -> None:
    found, box = leaving(views=100, stays=60)
    keep = ViewCheck(moment=3)(found, torch.arange(100)[None]).keep
    assert keep[box].float().mean() < 0.05
    assert keep[~box].all()


def test_views_come_in_any_order() -> None:
    found, _ = leaving()
    order = torch.tensor([3, 6, 0, 5, 2, 1, 4])
    cameras = found.cameras.select(order)
    mixed = replace(found, depth=found.depth[:, order], depth_conf=found.depth_conf[:, order], cameras=cameras)
    check = ViewCheck(moment=2)
    assert torch.equal(check(mixed, TIME[:, order] * 10).keep, check(found, TIME).keep[:, order])


def test_a_chair_that_moves_through_a_room_is_dropped_and_the_room_kept() -> None:
    views = 12
    room = SyntheticMovingRoom(1_000_001, views, (56, 84), distance=1.0, during=(0.6, 0.8))
    assert abs(np.linalg.norm(room.places[0] - room.places[-1]) - 1) < 1e-6
    frames = room.render(range(views), 1, samples=1)
    depth = torch.stack([torch.from_numpy(frame.depth) for frame in frames])
    room.world_at = lambda frame: room.world
    empty = torch.stack([torch.from_numpy(frame.depth) for frame in room.render(range(views), 1, samples=1)])
    chair = (empty - depth).abs()[None] > 0.01
    poses, matrix = torch.from_numpy(room.world_to_camera).float(), torch.from_numpy(room.intrinsics).float()
    found = geometry(depth, Cameras(poses[None], matrix.expand(1, views, 3, 3), (56, 84)))
    before, after = (ViewCheck(moment=moment)(found, torch.arange(views)[None]).keep for moment in (None, 3))
    assert 0.02 < chair.float().mean() < 0.3
    assert before[chair].float().mean() > 0.4
    assert after[chair].float().mean() < 0.1
    assert after[~chair].float().mean() > before[~chair].float().mean() - 0.005


def test_models_pass_on_when_frames_were_taken() -> None:
    config = compose("train", "model=pointcloud", "model.visibility=null", "name=x", "output_dir=x")
    model = instantiate(config.model, backend=instantiate(config.backend))
    model.visibility = ViewCheck(moment=2)
    found, box = leaving()
    with torch.no_grad():
        times = model.support(found, Hints(frame_ids=TIME))
        assert not times.keep[box].any()
        assert model.support(found, None).keep[box].any()
