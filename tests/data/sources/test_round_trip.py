"""Synthetic scene -> a dataset's layout on disk -> its loader: the same images, depth, poses and intrinsics."""

import pickle
from contextlib import nullcontext

import pytest
import torch

from vg2gt.data import DataError
from vg2gt.geometry.cameras import relative_to_first

from .layouts import SIZE, all_layouts, cameras_of, room

LAYOUTS = all_layouts()
NEED_ALL = ("rgbd", "rgbd_3x4", "rgbd_quaternions", "tanks_and_temples")
"""Poses belong to images by their order, so that none may be absent."""


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_scene_comes_back(name, tmp_path):
    layout, frames = LAYOUTS[name], room()
    layout.write(tmp_path, frames)
    source = layout.read(tmp_path)
    (scene,) = source.scenes
    ids, order = layout.frame_ids, [2, 0, 4]
    assert source.frames(scene) == tuple(ids)
    loaded = source.load(scene, [ids[i] for i in order])
    expected = frames.map(lambda tensor: tensor[order])
    assert loaded.images.shape[-2:] == SIZE
    assert float((loaded.images - expected.images).abs().mean()) <= layout.image_error + 1e-6
    if not source.has_cameras:
        assert layout.depth_quantum is None
        return
    cameras = [cameras_of(each) for each in (loaded, expected)]
    found, known = ((relative_to_first(each) if layout.moved_world else each).world_to_camera for each in cameras)
    torch.testing.assert_close(found, known, atol=1e-6, rtol=0)
    torch.testing.assert_close(loaded.intrinsics, expected.intrinsics, atol=1e-4, rtol=0)
    if layout.depth_quantum is None:
        assert not source.has_depth
        assert not loaded.depth.any()
        return
    assert source.has_depth
    valid = loaded.depth > 0
    assert bool(valid.any())
    error = (loaded.depth - expected.depth).abs()[valid]
    step = layout.depth_quantum(expected.depth)[valid] if callable(layout.depth_quantum) else layout.depth_quantum
    assert bool((error <= 0.5 * step + 1e-6).all())
    if not loaded.sparse_depth:
        assert torch.equal(valid, expected.depth > 0)


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_loader_travels_to_workers_and_its_index_is_cached_until_files_change(name, tmp_path):
    layout = LAYOUTS[name]
    layout.write(tmp_path / "data", room())
    source = layout.read(tmp_path / "data")
    (scene,) = source.scenes
    frame = source.frames(scene)[1]
    direct = pickle.loads(pickle.dumps(source)).load(scene, [frame])
    for _ in ("written", "read"):
        cached = layout.read(tmp_path / "data")
        cached.index_cache = tmp_path / "cache"
        again = cached.load(scene, [frame])
        for value, expected in zip(vars(again).values(), vars(direct).values(), strict=True):
            assert torch.equal(value, expected) if isinstance(value, torch.Tensor) else value == expected
        assert len(list((tmp_path / "cache").rglob("*.npz"))) == 1
    files = [path for path in sorted((tmp_path / "data").rglob("*")) if path.suffix in (".png", ".jpg", ".npy", ".pfm")]
    if len(files) > 2:  # else all is in one file
        files[-1].unlink()
        changed = layout.read(tmp_path / "data")
        changed.index_cache = tmp_path / "cache"
        with pytest.raises(DataError) if name in NEED_ALL else nullcontext():
            assert len(changed.frames(scene)) == len(source.frames(scene)) - 1
