"""TUM RGB-D's own traps: three clocks, lists of absent files, cameras known by the folder's name."""

import logging
import shutil

import numpy as np
import pytest

from examples.data_sets.tum import INTRINSICS, TUM, associate
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


@pytest.mark.parametrize(
    ("name", "camera"),
    [
        ("rgbd_dataset_freiburg1_xyz", "freiburg1"),
        ("rgbd_dataset_freiburg2_large_no_loop", "freiburg2"),
        ("fr3_office", "freiburg3"),
    ],
)
def test_the_folders_name_says_which_camera(tmp_path, frames, name, camera):
    write(tmp_path, frames, name)
    index = TUM(str(tmp_path)).scene_index(name)
    fx, fy, cx, cy = INTRINSICS[camera]
    assert index.intrinsics[0].tolist() == [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    given = TUM(str(tmp_path), intrinsics=[1, 2, 3, 4]).scene_index(name)
    assert given.intrinsics[0].tolist() == [[1, 0, 3], [0, 2, 4], [0, 0, 1]]


def test_an_unknown_camera_is_asked_for(tmp_path, frames):
    write(tmp_path, frames, "freiburg12")
    with pytest.raises(DataError, match=r"scene freiburg12 .*data.intrinsics=\[fx,fy,cx,cy\]"):
        TUM(str(tmp_path)).frames("freiburg12")


def test_files_are_listed_in_order_of_time(tmp_path, frames):
    write(tmp_path, frames)
    expected = TUM(str(tmp_path)).load(SCENE, [0, 1, 2])
    path = tmp_path / SCENE / "rgb.txt"
    path.write_text("\n".join(reversed(path.read_text().splitlines())))
    assert np.array_equal(TUM(str(tmp_path)).load(SCENE, [0, 1, 2]).images, expected.images)


def test_a_real_recording_without_poses_and_with_made_up_ones(shared, tmp_path, caplog):
    original = shared / "data" / "tum_layout"
    source = TUM(str(original), intrinsics=[525, 525, 319.5, 239.5])
    with pytest.raises(DataError, match=r"tum_layout.*has no groundtruth\.txt"):
        source.frames("tum_layout")
    folder = tmp_path / "freiburg1_recording"
    shutil.copytree(original, folder)
    times = [line.split()[0] for line in (folder / "rgb.txt").read_text().splitlines()[1:]]
    (folder / "groundtruth.txt").write_text("".join(f"{time} 0 0 0 0 0 0 1\n" for time in times))
    with caplog.at_level(logging.WARNING):
        source = TUM(str(folder))
        assert source.frames(folder.name) == tuple(range(10))
    assert f"{len(times) - 10} of {len(times)} frames without a colour image" in caplog.text
    loaded = source.load(folder.name, range(10))
    assert loaded.images.shape[-2:] == (480, 640)
    assert float(loaded.depth.max()) < 65535 / 5000
    assert float((loaded.depth > 0).float().mean()) == pytest.approx(1 - 0.357 - 0.030, abs=0.001)  # 0 and 65535
    assert float(loaded.depth[loaded.depth > 0].median()) == pytest.approx(1.111, abs=0.001)
