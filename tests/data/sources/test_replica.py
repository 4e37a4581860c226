"""Replica's own traps: intrinsics that no file holds, poses by line."""

import numpy as np
import pytest
from PIL import Image

from vg2gt.data import DataError
from vg2gt.data.sources import Replica


def write(root, size, frames, lines):
    """Frames of one size; the camera moves along x."""
    folder = root / "room1" / "results"
    folder.mkdir(parents=True)
    for i in frames:
        Image.fromarray(np.full((*size, 3), 90, np.uint8)).save(folder / f"frame{i:06d}.jpg")
        Image.fromarray(np.full(size, 13107, np.uint16)).save(folder / f"depth{i:06d}.png")
    poses = np.tile(np.eye(4), (lines, 1, 1))
    poses[:, 0, 3] = np.arange(lines)
    np.savetxt(root / "room1" / "traj.txt", poses.reshape(-1, 16))


def test_intrinsics_are_those_of_1200x680_and_images_of_another_shape_need_some(tmp_path):
    write(tmp_path / "full", (680, 1200), frames=[0], lines=1)
    full = Replica(str(tmp_path / "full")).load("room1", [0])
    assert full.intrinsics[0].tolist() == [[600, 0, 599.5], [0, 600, 339.5], [0, 0, 1]]
    assert float(full.depth[0, 0, 0]) == pytest.approx(2.0)
    write(tmp_path / "small", (17, 30), frames=[1, 3], lines=5)  # of the video's frames only some were kept
    given = Replica(str(tmp_path / "small" / "room1"), intrinsics=[16, 17, 14, 9])
    assert given.scene_index("room1").intrinsics[0].tolist() == [[16, 0, 14], [0, 17, 9], [0, 0, 1]]
    assert given.load("room1", [1, 3]).world_to_camera[:, 0, 3].tolist() == [-1, -3]
    with pytest.raises(DataError, match=r"scene room1 .* are 30x17, not 1200x680.*data.intrinsics=\[fx,fy,cx,cy\]"):
        Replica(str(tmp_path / "small")).frames("room1")
