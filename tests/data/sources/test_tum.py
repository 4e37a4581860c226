"""TUM RGB-D's own traps: three clocks, lists of absent files, cameras known by the folder's name."""

import numpy as np
import pytest

from examples.data_sets.tum import TUM, associate
from vg2gt.data import DataError

from .layout_tum import write
from .layouts import room


def test_times_are_paired_nearest_first_and_once():
    times = np.array([0.0, 1.0, 2.0, 3.0])
    others = np.array([0.015, 0.99, 1.004, 2.03, 2.995])
    assert associate(times, others, 0.02) == {0: 0, 1: 2, 3: 4}
    # 1.0 and 1.01 both are nearest to 1.008: the nearer one takes it, the other the next.
    assert associate(np.array([1.0, 1.01]), np.array([0.985, 1.008]), 0.02) == {0: 0, 1: 1}
    assert associate(np.array([1.0, 1.01]), np.array([1.008]), 0.02) == {1: 0}
    assert associate(times, np.zeros(0), 0.02) == {}


def test_an_unknown_camera_is_asked_for(tmp_path):
    write(tmp_path, room(3), "freiburg12")
    with pytest.raises(DataError, match=r"scene freiburg12 .*data.intrinsics=\[fx,fy,cx,cy\]"):
        TUM(str(tmp_path)).frames("freiburg12")
