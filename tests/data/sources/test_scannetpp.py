"""ScanNet++'s own traps: names in the cameras' file, DSLR images among them, COLMAP's pixel centres."""

import logging

import numpy as np
import pytest
import torch

from examples.data_sets.scannetpp import ScanNetPPiPhone
from vg2gt.data import DataError

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


def _save(folder, **changes):
    path = folder / "scene_iphone_metadata.npz"
    arrays = {**np.load(path), **changes}
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})


DAMAGE = {
    "fewer poses": (lambda f: _save(f, trajectories=np.eye(4)[None]), "trajectories in .* must hold 5x4x4 numbers"),
    "no intrinsics": (lambda f: _save(f, intrinsics=None), "has no array"),
    "numbers for names": (lambda f: _save(f, images=np.arange(5)), "must be a list of file names"),
    "one name": (lambda f: _save(f, images=np.array("frame_000000.jpg")), "must be a list of file names"),
    "objects": (lambda f: _save(f, images=np.array(["a"] * 5, object)), "cannot read .*metadata.npz of scene"),
    "a DSLR name": (
        lambda f: _save(f, images=np.array([f"DSC0{i}.JPG" for i in range(5)])),
        r"names an image 'DSC00.JPG'",
    ),
    "a name twice": (lambda f: _save(f, images=np.array(["frame_000010.jpg"] * 5)), "names frame 10 twice"),
    "none of its images": (
        lambda f: _save(f, images=np.array([f"frame_{i}.jpg" for i in range(5, 10)])),
        "has no images of iPhone frames",
    ),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_named(tmp_path, frames, name):
    write(tmp_path, frames)
    damage, message = DAMAGE[name]
    damage(tmp_path / "processed" / SCENE)
    with pytest.raises(DataError, match=message):
        ScanNetPPiPhone(str(tmp_path)).frames(SCENE)
