"""ScanNet++'s own traps: names in the cameras' file, DSLR images among them, COLMAP's pixel centres."""

import logging

import numpy as np
import pytest
import torch

from examples.data_sets.scannetpp import ScanNetPPiPhone

from .layout_scannetpp import write, write_cameras
from .layouts import camera_to_world, room

SCENE = "0a5c013435"


@pytest.fixture(scope="module")
def frames():
    return room(4)


def test_cameras_belong_to_names_not_to_positions(tmp_path, frames, caplog):
    """The layout's file lists the cameras from the last to the first, and one whose image is absent."""
    write(tmp_path, frames)
    with caplog.at_level(logging.WARNING):
        source = ScanNetPPiPhone(str(tmp_path))
        assert source.frames(SCENE) == (0, 10, 20, 30)
    assert "1 of 5 frames without a colour image" in caplog.text
    loaded = source.load(SCENE, [30, 0])
    assert torch.allclose(loaded.world_to_camera, frames.world_to_camera[[3, 0]], atol=1e-6)
    stored = np.load(tmp_path / "processed" / SCENE / "scene_iphone_metadata.npz")["intrinsics"][0]
    assert float(loaded.intrinsics[0, 0, 2]) == pytest.approx(stored[0, 2] - 0.5)


def test_each_frame_has_its_own_intrinsics(tmp_path, frames):
    write(tmp_path, frames)
    names = [f"frame_{10 * i:06d}" for i in range(4)]
    matrices = [frames.intrinsics[0].double().numpy() * [[i + 1], [i + 1], [1]] for i in range(4)]
    write_cameras(tmp_path / "processed" / SCENE, names, list(camera_to_world(frames)), matrices)
    loaded = ScanNetPPiPhone(str(tmp_path)).load(SCENE, [0, 10, 20, 30])
    ratios = loaded.intrinsics[:, 0, 0] / frames.intrinsics[0, 0, 0]
    assert ratios.tolist() == pytest.approx([1, 2, 3, 4])
