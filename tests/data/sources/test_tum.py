"""TUM RGB-D's own traps: three clocks, lists of absent files, cameras known by the folder's name."""

import logging

import numpy as np
import pytest

from examples.data_sets.tum import TUM, associate
from vg2gt.data import DataError

from .layout_tum import write
from .layouts import room

SCENE = "rgbd_dataset_freiburg1_desk"


@pytest.fixture(scope="module")
def frames():
    return room(3)


def test_times_are_paired_nearest_first_and_once():
    times = np.array([0.0, 1.0, 2.0, 3.0])
    others = np.array([0.015, 0.99, 1.004, 2.03, 2.995])
    assert associate(times, others, 0.02) == {0: 0, 1: 2, 3: 4}
    # 1.0 and 1.01 both are nearest to 1.008: the nearer one takes it, the other the next.
    assert associate(np.array([1.0, 1.01]), np.array([0.985, 1.008]), 0.02) == {0: 0, 1: 1}
    assert associate(np.array([1.0, 1.01]), np.array([1.008]), 0.02) == {1: 0}
    assert associate(times, np.zeros(0), 0.02) == {}


def test_absent_files_are_counted(tmp_path, frames, caplog):
    """The layout's lists name two images that do not exist."""
    write(tmp_path, frames)
    (tmp_path / SCENE / "depth").joinpath(sorted(p.name for p in (tmp_path / SCENE / "depth").iterdir())[1]).unlink()
    with caplog.at_level(logging.WARNING):
        assert TUM(str(tmp_path)).frames(SCENE) == (0, 2)
    assert "1 of 5 frames without a depth file" in caplog.text
    assert "2 of 5 frames without a colour image" in caplog.text


def test_frames_apart_in_time_do_not_belong_together(tmp_path, frames):
    """Depth is taken 11 ms after colour, poses are 3 ms apart."""
    write(tmp_path, frames)
    assert len(TUM(str(tmp_path), max_difference=0.012).frames(SCENE)) == 3
    with pytest.raises(DataError, match=r"has no depth images: none of those listed in depth\.txt"):
        TUM(str(tmp_path), max_difference=0.010).frames(SCENE)


def test_an_unknown_camera_is_asked_for(tmp_path, frames):
    write(tmp_path, frames, "freiburg12")
    with pytest.raises(DataError, match=r"scene freiburg12 .*data.intrinsics=\[fx,fy,cx,cy\]"):
        TUM(str(tmp_path)).frames("freiburg12")
