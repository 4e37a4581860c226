"""What two cameras in front of a wall know of it."""

import math

import pytest
import torch

from vg2gt.types import Cameras, Geometry
from vg2gt.visibility import Status, pixel_evidence, point_support
from vg2gt.visibility.evidence import EVIDENCE

SIZE, FOCAL, BASELINE, WALL = (40, 60), 50.0, 0.5, 2.0


@pytest.fixture
def cameras() -> Cameras:
    """Side by side, looking at the wall z = 2: it moves by 12.5 pixels from one to the other."""
    pose = torch.eye(4).repeat(1, 2, 1, 1)
    pose[0, 1, 0, 3] = -BASELINE
    k = torch.tensor([[FOCAL, 0, (SIZE[1] - 1) / 2], [0, FOCAL, (SIZE[0] - 1) / 2], [0, 0, 1]])
    return Cameras(pose, k.repeat(1, 2, 1, 1), SIZE)


def geometry(cameras: Cameras) -> Geometry:
    depth = torch.full((1, 2, *SIZE), WALL)
    return Geometry(depth, torch.full_like(depth, 20.0), cameras, torch.ones(1))


def test_the_status_of_pixels(cameras: Cameras) -> None:
    seen = geometry(cameras)
    alone = Geometry(seen.depth[:, :1], seen.depth_conf[:, :1], cameras.select(slice(0, 1)), seen.scale)
    evidence, status = pixel_evidence(alone)
    assert (status == Status.SINGLE).all()
    assert evidence.isfinite().all()
    seen.depth[0, 0, 20, 40] = WALL / 2  # hangs in the air: the other camera looks through it
    seen.depth[0, 0, 5, 5] = 0
    keep = torch.ones(1, 2, *SIZE, dtype=torch.bool)
    keep[0, 0, 30, 50] = False
    evidence, status = pixel_evidence(seen, keep)
    assert evidence.shape == (2, *SIZE, len(EVIDENCE))
    assert evidence.isfinite().all()
    assert status[0, 20, 40] == Status.CONTRADICTED
    assert status[0, 30, 50] == Status.CONTRADICTED
    assert status[0, 5, 5] == Status.GUESSED
    assert (status[0, :, :11] == Status.SINGLE).sum() == 11 * SIZE[0] - 1  # left of what the right camera sees
    assert status[0, 20, 20] == Status.AGREED
    assert (status[1, :, :46] == Status.AGREED).float().mean() > 0.99


def test_the_evidence_of_pixels(cameras: Cameras) -> None:
    seen = geometry(cameras)
    seen.depth[0, 0, 20, 40:] = 1.1 * WALL
    evidence, _ = pixel_evidence(seen)
    named = dict(zip(EVIDENCE, evidence.unbind(-1), strict=True))
    assert named["confidence"][0, 0, 0] == pytest.approx(torch.tensor(20.0).log())
    assert named["views"][0, 20, 20] == 1  # log2 of one view more
    assert named["closely"][0, 20, 20] == 1
    assert -14 < named["differences"][0, 5, 5] == named["differences"][1, 30, 40] < -10  # three quarters agree
    assert named["step"][0, 20, 39].exp() == pytest.approx(0.1, rel=1e-4)
    assert named["step"][0, 10, 10] < -10
    assert named["parallax"][0, 10, 10].exp() == pytest.approx(WALL / (FOCAL * BASELINE), rel=1e-4)


def test_the_differences_are_their_upper_quartile_and_unknown_without_overlap(cameras: Cameras) -> None:
    seen = geometry(cameras)
    seen.depth[0, 0, :, 12::2] *= 1.1  # half of what both see; it is 1 / 11 off for the other view, or hidden
    differences = pixel_evidence(seen)[0][..., -1]
    assert 0.09 < differences[0, 0, 0].exp() < 0.11
    alone = Geometry(seen.depth[:, :1], seen.depth_conf[:, :1], cameras.select(slice(0, 1)), seen.scale)
    assert (pixel_evidence(alone)[0][..., -1] == 0).all()


def test_the_status_of_points(cameras: Cameras) -> None:
    depth = geometry(cameras).depth[0]
    depth[:, 35:] = 0
    error = torch.full_like(depth, 0.02)
    error[1] = 0.01
    points = torch.tensor(
        [
            [0.2, 0.0, WALL],  # both see it
            [-1.0, 0.0, WALL],  # left of the right camera's image
            [0.2, 0.0, WALL / 2],  # both look through it
            [0.2, 0.0, 2 * WALL],  # behind the wall
            [0.2, 0.7, WALL],  # where no depth was found
            [0.2, 0.0, -WALL],  # behind the cameras
            [0.2, 0.0, 1.01 * WALL],
        ]
    )
    status, bound = point_support(points, depth, cameras, error)
    expected = ["AGREED", "SINGLE", "CONTRADICTED", "UNSEEN", "GUESSED", "UNSEEN", "AGREED"]
    assert [Status(int(kind)).name for kind in status] == expected
    expected = [0.01, 0.02, *4 * [math.inf], 1.01 * 1.01 - 1]
    torch.testing.assert_close(bound, torch.tensor(expected), atol=1e-4, rtol=1e-4)
    assert point_support(points, depth, cameras)[1][0] == pytest.approx(0, abs=1e-5)
