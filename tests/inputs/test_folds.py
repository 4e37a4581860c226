"""Equal sides of an object, which structure from motion puts on top of each other; and cameras that did not move."""

from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.inputs.match_database import Dots, box, floor, orbit, write_database
from vg2gt.inputs import folds, sfm
from vg2gt.inputs.folds import _covering, contradicted_images, unfold
from vg2gt.inputs.motion import check_motion, check_parallax, why_not_placed
from vg2gt.inputs.pair_evidence import Matches
from vg2gt.io.colmap import colmap_from_views, quiet_colmap
from vg2gt.monitor import Monitor
from vg2gt.types import Cameras

pytest.importorskip("pycolmap")
COUNT = 16


def solved(folder: Path, dots: Dots):
    """Models with all matches, those without false ones, and the images that fit at two places."""
    with quiet_colmap():
        write_database(folder / "database.db", orbit(COUNT), dots)
        (folder / "images").mkdir()
        matches = Matches.read(folder / "database.db")
        check_motion(matches)

        def again():
            return sfm._map(folder, COUNT, Monitor())

        folded = again()
        return folded, *unfold(folder / "database.db", matches, folded, again), matches


def largest_error(model) -> float:
    """Of the turns between all pairs of images, in degrees; as many images as were photographed."""
    placed = {image.name: image.cam_from_world().rotation.matrix() for image in model.images.values()}
    assert len(placed) == COUNT
    found, true = np.stack([placed[name] for name in sorted(placed)]), orbit(COUNT)[:, :3, :3]
    apart = [np.einsum("aij,bkj->abik", turns, turns) for turns in (found, true)]
    cosine = (np.einsum("abij,abij->ab", *apart) - 1) / 2
    return float(np.degrees(np.arccos(cosine.clip(-1, 1))).max())


def test_different_sides_are_left_alone(tmp_path: Path) -> None:
    folded, models, undecided, _ = solved(tmp_path, box((1, 2, 3, 4)))
    assert models is folded
    assert undecided == []
    assert largest_error(models[0]) < 2


@pytest.mark.parametrize("sides", [(1, 2, 1, 2), pytest.param((1, 1, 1, 1), marks=pytest.mark.slow)])
def test_equal_sides_are_told_apart_by_the_ground(tmp_path: Path, sides) -> None:
    folded, models, undecided, _ = solved(tmp_path, box(sides).joined(floor()))
    assert sides[1] == 1 or largest_error(folded[0]) > 80
    assert largest_error(models[0]) < 2
    assert undecided == []


def test_pairs_that_look_different_among_more_that_do_not_remove_nothing() -> None:
    """They cost 31 of 55 photographs of a kitchen, where 101 of 393 pairs look different."""
    for differ, alike, folded in ((101, 292, False), (4, 44, False), (17, 17, True), (2, 1, False)):
        verdict = {(str(number), ""): number >= differ for number in range(differ + alike)}
        assert folds._is_folded(verdict) is folded


def test_equal_sides_before_nothing_are_said(tmp_path: Path) -> None:
    _, models, undecided, matches = solved(tmp_path, box((1, 2, 1, 2)))
    assert len(undecided) >= 4
    assert undecided == contradicted_images(models, matches)


def test_pairs_are_chosen_by_what_few_images_share() -> None:
    """Sides that fill half of the image are in all of them, the ground only in neighbours: those are taken first."""
    noise, names = np.random.default_rng(0), [f"{number:06d}.jpg" for number in range(12)]
    side, ground = noise.uniform([400, 100], [1200, 900], (300, 2)), noise.uniform([0, 700], [1600, 1200], (200, 2))
    features = dict.fromkeys(names, np.concatenate([side, ground]))
    pairs = {}
    for later in range(12):
        for before in range(later):
            rows = noise.permutation(300)[:200]
            if (later - before) % 12 in (1, 11):
                rows = np.concatenate([rows, 300 + noise.permutation(200)[:120]])
            pairs[names[before], names[later]] = np.tile(rows[:, None], 2)
    found = _covering(Matches(dict.fromkeys(names, (1600, 1200)), features, pairs, dict(pairs)))
    assert found == {tuple(sorted((names[at], names[at - 1]))) for at in range(12)}


def still(count: int, static: int, moving: int, shift: float) -> Matches:
    """Matches of images of 1600x1200: a ring of static features, and others in the middle that move between images."""
    noise, names = np.random.default_rng(0), [f"{number:06d}.jpg" for number in range(count)]
    angle, radius = noise.uniform(0, 2 * np.pi, static), noise.uniform(450, 590, static)
    fixed = np.stack([800 + radius * np.cos(angle), 600 + radius * np.sin(angle)], 1)
    turning = noise.uniform([600, 400], [1000, 800], (moving, 2))
    features = {
        name: np.concatenate([fixed, turning + np.array([shift * number, 0])])
        + noise.normal(0, 0.3, (static + moving, 2))
        for number, name in enumerate(names)
    }
    rows = np.tile(np.arange(static + moving)[:, None], 2)
    pairs = {(one, other): rows for number, other in enumerate(names) for one in names[:number]}
    return Matches(dict.fromkeys(names, (1600, 1200)), features, pairs, dict(pairs))


@pytest.mark.parametrize(
    ("matches", "said"),
    [
        (still(6, 300, 200, 20), "background is in place in 15 of 15 pairs of images, while something turns.*Mask it"),
        (still(6, 300, 0, 0), "the camera did not move: features stay within 1 %.*walk around"),
        (still(6, 0, 300, 1.5), "the camera did not move: features stay within 1 %"),  # a burst
        (still(2, 0, 300, 4), "the camera did not move: features stay within 1 %"),
        (still(6, 0, 300, 60), None),
        (still(6, 30, 300, 60), None),  # few still features, such as a mark of a drone's camera
    ],
    ids=["turntable", "tripod", "burst", "two", "moved", "marked"],
)
def test_a_camera_that_did_not_move_is_said(matches: Matches, said: str | None) -> None:
    with nullcontext() if said is None else pytest.raises(ValueError, match=said):
        check_motion(matches)


def turned(step: float):
    """A model of eight views that turn by 8 degrees and move by ``step``, 4 to 9 away from what they show."""
    generator = np.random.default_rng(0)
    points = generator.uniform((-5, -2, 4), (5, 2, 9), (300, 3))
    angles = np.deg2rad(8 * np.arange(8) - 28)
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, 0, 0] = poses[:, 2, 2] = np.cos(angles)
    poses[:, 0, 2], poses[:, 2, 0] = -np.sin(angles), np.sin(angles)
    poses[:, :3, 3] = -poses[:, :3, 0] * step * np.arange(8)[:, None]
    matrix = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
    local = points @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]
    shown = local @ matrix.T
    pixels = shown[..., :2] / shown[..., 2:] + generator.normal(0, 0.3, (8, 300, 2))
    view, point = ((local[..., 2] > 0) & (pixels > 0).all(-1) & (pixels < (640, 480)).all(-1)).nonzero()
    cameras = Cameras(torch.tensor(poses)[None], torch.tensor(matrix).expand(1, 8, 3, 3), (480, 640))
    names = [f"{number}.jpg" for number in range(8)]
    return colmap_from_views(cameras, names, points, None, (point, view, pixels[view, point]))


def test_a_turn_on_the_spot_is_said() -> None:
    with pytest.raises(ValueError, match=r"only turned on the spot.*walk around"):
        check_parallax(turned(0.0))
    check_parallax(turned(0.2))


@pytest.mark.parametrize(
    ("matches", "said"),
    [
        (
            still(2, 0, 43, 60),
            "the two images have 43 features in common, about 100 are needed, so they overlap too",
        ),
        (still(3, 0, 430, 60), "that match best have 430 features in common, enough, but the camera only turned"),
        (still(2, 0, 0, 0), "the two images have no features in common"),
        (still(2, 0, 430, 60), "the two images have 430 features in common, but two images do not determine"),
    ],
)
def test_what_two_photographs_lack_is_said(matches: Matches, said: str) -> None:
    assert said in why_not_placed(matches)
