"""Holes of a scene are filled with Gaussians that refinement can go on from."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.refinement.conftest import VIEWS, Start, run
from vg2gt.geometry.cameras import project
from vg2gt.geometry.spherical_harmonics import sh_to_rgb
from vg2gt.refinement import RefineOptions
from vg2gt.refinement.density import COVERED, fill_holes, spread, with_points
from vg2gt.types import Gaussians

ROOM = 10_000


@pytest.fixture(scope="module")
def holed(start: Start) -> Start:
    """The scene as a backbone leaves it that has no depth of the left third of view 0, whatever view sees it."""
    pixels, depth = project(start.gaussians.means[None, None], start.cameras.select(slice(0, 1)))
    left = (depth[0, 0] > 0) & (pixels[0, 0, :, 0] < start.cameras.size[1] / 3)
    kept = start.gaussians.select(~left)
    uncovered = start.renderer(kept, start.cameras).alpha[0] < COVERED
    return replace(start, gaussians=kept, seen=replace(start.seen, depth=start.seen.depth * ~uncovered))


def holes(start: Start, gaussians: Gaussians) -> torch.Tensor:
    """Share of each view that no Gaussian covers."""
    return (start.renderer(gaussians, start.cameras).alpha[0] < COVERED).float().mean((1, 2))


def fill(start: Start, room: int = ROOM) -> Gaussians:
    views = torch.arange(VIEWS)
    return fill_holes(start.gaussians, start.cameras, start.seen, start.renderer, views, side=4, room=room)


def test_holes_are_covered_once_and_blocks_grow_to_the_room_there_is(holed: Start) -> None:
    assert holes(holed, holed.gaussians)[0] > 0.2
    filled = fill(holed)
    assert (holes(holed, filled) < 0.03).all()
    assert torch.equal(filled.means[: len(holed.gaussians)], holed.gaussians.means)
    once = len(filled) - len(holed.gaussians)
    covered = (holes(holed, holed.gaussians).sum() * holed.seen.depth[0].numel() / 16).round()
    assert 0 < once < 0.7 * float(covered)  # a Gaussian for each block of each view
    assert len(fill(replace(holed, gaussians=filled))) - len(filled) < 0.05 * once
    assert 0 < len(fill(holed, room=40)) - len(holed.gaussians) <= 40
    assert fill(holed, room=0) is holed.gaussians


def test_depth_spreads_from_around_a_hole() -> None:
    depth = torch.full((1, 16, 24), 2.0)
    depth[:, :, 12:] = 4.0
    known = depth.clone()
    known[:, 4:12, 8:16] = 0
    filled = spread(known)
    assert torch.equal(filled[known > 0], known[known > 0])
    inside = filled[0, 4:12, 8:16]
    assert ((inside >= 2) & (inside <= 4)).all()
    assert (inside.diff(dim=1) > -0.2).all()
    assert (inside[:, 0] < inside[:, -1]).all()
    assert float(spread(torch.zeros(1, 5, 7)).max()) < 1.001  # nothing known: no number is wrong


def test_refinement_fills_unless_told_not_to(holed: Start) -> None:
    with_fill, without = (run(holed, RefineOptions(steps=12, check_every=6, holdout=3, fill=side)) for side in (4, 0))
    assert with_fill.psnr[1, with_fill.held_out].mean() > without.psnr[1, without.held_out].mean() + 1
    assert len(without.scene.gaussians) <= len(holed.gaussians)


def test_points_get_gaussians_where_there_are_none(holed: Start, start: Start) -> None:
    """Of points on the whole surface, those in the hole are added, with their colours and the size of their gaps."""
    step = 7
    points, colors = (
        start.gaussians.means[::step],
        sh_to_rgb(start.gaussians.sh[::step, :1], start.gaussians.means[::step]),
    )
    found = with_points(holed.gaussians, points, colors)
    added = found.select(torch.arange(len(found)) >= len(holed.gaussians))
    lost = len(start.gaussians) - len(holed.gaussians)
    assert 0.6 * lost / step < len(added) < 1.2 * lost / step
    torch.testing.assert_close(sh_to_rgb(added.sh[:, :1], added.means), colors[torch.isin(points, added.means).all(1)])
    gaps = torch.cdist(added.means, points).topk(4, largest=False).values[:, 1:].mean(1)
    torch.testing.assert_close(added.scales, gaps[:, None].expand(-1, 3), rtol=1e-3, atol=1e-5)
    before, after = holes(holed, holed.gaussians)[0], holes(holed, found)[0]
    assert after < 0.6 * before
    assert len(with_points(start.gaussians, points, colors)) == len(start.gaussians)  # they have one already
    assert len(with_points(holed.gaussians, points[:3], colors[:3])) == len(holed.gaussians)
