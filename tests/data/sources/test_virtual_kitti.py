"""Virtual KITTI 2's own traps: two cameras in one file, the sky, many recordings of one drive."""

import numpy as np
import pytest
import torch
from PIL import Image

from examples.data_sets.virtual_kitti import VirtualKITTI2

from .layout_virtual_kitti import write
from .layouts import room

SCENE = "Scene06/fog/Camera_0"


@pytest.fixture(scope="module")
def frames():
    return room(3)


def test_what_is_too_far_has_no_depth(tmp_path, frames):
    write(tmp_path, frames)
    path = tmp_path / "Scene06/fog/frames/depth/Camera_0/depth_00001.png"
    stored = np.array(Image.open(path))
    stored[0, :4] = (65535, 8001, 7999, 100)
    Image.fromarray(stored).save(path)
    depth = VirtualKITTI2(str(tmp_path)).load(SCENE, [1]).depth[0, 0, :4]
    assert depth.tolist() == pytest.approx([0, 0, 79.99, 1])
    depth = VirtualKITTI2(str(tmp_path), max_depth=700).load(SCENE, [1]).depth[0, 0, :4]
    assert depth.tolist() == pytest.approx([655.35, 80.01, 79.99, 1])


def test_each_camera_has_its_own_rows(tmp_path, frames):
    """The rows of the other camera are displaced by 1 m along the image's x axis."""
    write(tmp_path, frames, camera=1)
    write(tmp_path / "left", frames)
    source = VirtualKITTI2(str(tmp_path))
    assert source.scenes == ("Scene06/fog/Camera_1",)
    right = source.load("Scene06/fog/Camera_1", [2]).world_to_camera
    assert torch.allclose(right, frames.world_to_camera[2:], atol=1e-6)
    (tmp_path / "Scene06/fog/frames/rgb/Camera_1").rename(tmp_path / "Scene06/fog/frames/rgb/Camera_0")
    (tmp_path / "Scene06/fog/frames/depth/Camera_1").rename(tmp_path / "Scene06/fog/frames/depth/Camera_0")
    left = VirtualKITTI2(str(tmp_path)).load(SCENE, [2]).world_to_camera
    assert torch.allclose(left[:, 0, 3] - right[:, 0, 3], torch.tensor(-1.0))


def test_variations_and_cameras_of_a_drive_show_one_place(tmp_path, frames):
    for variation, camera in (("Scene06/fog", 0), ("Scene06/rain", 1), ("Scene20/clone", 0)):
        write(tmp_path, frames, variation, camera)
    source = VirtualKITTI2(str(tmp_path))
    assert source.scenes == (SCENE, "Scene06/rain/Camera_1", "Scene20/clone/Camera_0")
    assert [source.place(scene) for scene in source.scenes] == ["Scene06", "Scene06", "Scene20"]
    assert VirtualKITTI2(str(tmp_path), scenes=["Scene06/*"]).scenes == (SCENE, "Scene06/rain/Camera_1")
    assert VirtualKITTI2(str(tmp_path), scenes=["*/Camera_0"]).scenes == (SCENE, "Scene20/clone/Camera_0")
