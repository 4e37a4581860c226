"""Given cameras that contradict their images, on real photographs with known cameras."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.inputs.test_usable import scenery
from vg2gt.data.base import DataError
from vg2gt.data.sources.sparse_points import ObservedPoints
from vg2gt.inputs import camera_check
from vg2gt.inputs.camera_check import check_cameras
from vg2gt.inputs.given_cameras import given_pictures
from vg2gt.inputs.pictures import Picture, frame_of
from vg2gt.monitor import Monitor

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def right(shared: Path) -> list[Picture]:
    pytest.importorskip("pycolmap")
    return given_pictures(shared / "data" / "hololens_office_a", 7) or []


@pytest.fixture(scope="module", autouse=True)
def _matched_once(right: list[Picture]):
    """The features of the same images are found and matched once."""
    found = camera_check.match_pictures(right)

    def match_pictures(pictures):
        numbers = {f"{number:06d}.jpg": picture for number, picture in enumerate(pictures)}
        return found[0], {name: replace(found[1][name], pose=each.pose) for name, each in numbers.items()}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(camera_check, "match_pictures", match_pictures)
        yield


def turned(pictures: list[Picture], change: Callable[[int, np.ndarray], np.ndarray]) -> list[Picture]:
    return [replace(each, pose=change(number, each.pose)) for number, each in enumerate(pictures)]


def test_right_cameras_pass(right: list[Picture], caplog) -> None:
    check_cameras(right, Monitor())
    assert not caplog.records


def test_images_that_a_model_is_not_made_of(caplog) -> None:
    """Renamed photographs, or frames of a video taken again: the names fit, but its points are somewhere else."""
    wall, places = scenery(0, (60, 200)), np.random.default_rng(0).uniform((0, 0), (1, 1), (400, 2))
    views = []
    for left in range(0, 120, 20):
        inside = (places * (200, 60) - (left, 0)) / (80, 60)
        seen = ((inside >= 0) & (inside < 1)).all(1)
        points = ObservedPoints(np.flatnonzero(seen), inside[seen], np.ones(seen.sum(), np.float32))
        pixels = wall[:, left : left + 80]
        read = partial(lambda pixels, _: frame_of(pixels), pixels)
        views.append(Picture(str(left), (60, 80), read, "COLMAP folder", points=points, pose=np.eye(4)))
    check_cameras(views, Monitor())
    assert not caplog.records
    others = [replace(each, read=other.read) for each, other in zip(views, views[::-1], strict=True)]
    with pytest.raises(DataError, match="the images are not those that COLMAP folder was made of"):
        check_cameras(others, Monitor())
    check_cameras(others, Monitor(), insisted=True)
    assert "they are used as they are" in caplog.text


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda _, pose: np.linalg.inv(pose), "world-to-camera, or the reverse: correct"),
        (lambda _, pose: FLIP @ pose, "if the poses are in OpenGL axes"),
        (lambda _, pose: np.linalg.inv(pose) @ FLIP, "or the reverse, and in the other of OpenGL's"),
        (lambda number, pose: None, "Check their order"),
    ],
)
def test_what_is_wrong_is_said(right: list[Picture], change, said: str, caplog) -> None:
    poses = [each.pose for each in right]
    if "order" in said:
        wrong = [replace(each, pose=pose) for each, pose in zip(right, poses[::-1], strict=True)]
    else:
        wrong = turned(right, change)
    with pytest.raises(DataError, match=r"contradict the images: in \d of \d pairs") as error:
        check_cameras(wrong, Monitor())
    assert said in str(error.value)
    assert "--poses sfm" in str(error.value)
    with pytest.raises(DataError) as error:
        check_cameras([replace(each, source="Nerfstudio folder") for each in wrong], Monitor())
    if "in the other of" in said:  # a transforms.json has OpenGL axes, so its poses are only inverse
        assert "world-to-camera, or the reverse: correct" in str(error.value)
    check_cameras(wrong, Monitor(), insisted=True)
    assert "they are used as they are" in caplog.text


def test_a_camera_out_of_line_is_looked_at(right: list[Picture]) -> None:
    """Among many images, of which only some are checked."""
    line = [np.eye(4) + np.outer(np.eye(4)[0], [0, 0, 0, step]) for step in range(40)]
    assert camera_check._out_of_line([replace(right[0], pose=pose) for pose in line]) == []
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("y", 60, degrees=True).as_matrix()
    for wrong in (turn @ line[17], line[30]):
        poses = [*line[:17], wrong, *line[18:]]
        assert camera_check._out_of_line([replace(right[0], pose=pose) for pose in poses]) == [17]


def test_single_wrong_cameras_are_named(right: list[Picture], caplog) -> None:
    wrong = turned(right, lambda number, pose: np.linalg.inv(pose) if number == 6 else pose)
    check_cameras(wrong, Monitor())
    assert "some cameras may be wrong" in caplog.text
    assert right[6].name in caplog.text
    assert right[0].name not in caplog.text


@pytest.mark.parametrize("turn", [1, -1])
def test_cameras_in_one_place_see_in_the_same_direction(turn: int) -> None:
    """As the faces of a panorama and the photographs of a tripod; a turn the wrong way does not fit."""
    intrinsics = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("y", 10, degrees=True).as_matrix()
    there = np.random.default_rng(0).uniform((-0.2, -0.2, 1), (0.2, 0.2, 1), (50, 3))
    shown = [there @ intrinsics.T, there @ pose[:3, :3].T @ intrinsics.T]
    pixels = [each[:, :2] / each[:, 2:] for each in shown]
    pose[:3, :3] = Rotation.from_euler("y", 10 * turn, degrees=True).as_matrix()
    views = [camera_check.CheckedView(intrinsics, each, (480, 640)) for each in (np.eye(4), pose)]
    assert (camera_check._distance(pixels, views) < 0.02).mean() == (turn == 1)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ([[0.8, 1, 1], [1, 0.8, 1], [1, 1, 1]], r"a focal length of about 1\.2"),
        ([[1.25, 1, 1], [1, 1.25, 1], [1, 1, 1]], r"a focal length of about 0\.[78]"),
        ([[1, 1, 1], [1, 0.8, 1], [1, 1, 1]], r"a vertical focal length of about 1\.2"),
        ([[1, 1, 1.3], [1, 1, 1], [1, 1, 1]], r"a principal point moved by about -1\d% of the width"),
        ([[1, 1, 1], [1, 1, 0.6], [1, 1, 1]], r"a principal point moved by about \+\d\d% of the height"),
    ],
)
def test_a_wrong_lens_is_said(right: list[Picture], change, said: str, monkeypatch, caplog) -> None:
    matches, views = camera_check.match_pictures(right)
    assert not camera_check.better_lens(matches, views)
    wrong = {name: replace(view, intrinsics=view.intrinsics * np.array(change)) for name, view in views.items()}
    monkeypatch.setattr(camera_check, "match_pictures", lambda _: (matches, wrong))
    check_cameras(right, Monitor(), insisted=True)  # whether or not it is wrong enough to be an error
    assert re.search(f"better with {said}", caplog.text)
