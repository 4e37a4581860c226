"""RGB-D folders: round trip, layouts, splits, damage, and real recordings by geometry."""

import shutil
from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
import torch
from PIL import Image

from vg2gt.data import DataError, RGBDFolder

from .conftest import SIZE, module_of
from .sources.layout_rgbd import write_seven_scenes
from .sources.layouts import room
from .warping import depth_differences


def test_intrinsics_beside_the_sequences_of_seven_scenes(tmp_path):
    write_seven_scenes(tmp_path / "data", room(2))
    root, path = tmp_path / "data" / "chess", tmp_path / "data" / "chess" / "camera-intrinsics.txt"
    for focal in (30, 60):  # read again when they are edited
        np.savetxt(path, [[focal, 0, 15], [0, 31, 11], [0, 0, 1]])
        source = RGBDFolder(str(root), index_cache=str(tmp_path / "cache"))
        assert float(source.load("seq-01", [0]).intrinsics[0, 0, 0]) == focal
    path.unlink()
    with pytest.raises(DataError, match=r"no intrinsics.*data.intrinsics=\[fx,fy,cx,cy\]"):
        RGBDFolder(str(root)).frames("seq-01")
    given = RGBDFolder(str(root), intrinsics=(30, 31, 15.5, 11.5))
    assert given.scenes == ("seq-01",)
    assert given.load("seq-01", [0]).intrinsics[0].tolist() == [[30, 0, 15.5], [0, 31, 11.5], [0, 0, 1]]


def test_recordings_of_one_room_show_one_place(write_recording):
    folder = write_recording()
    root = folder.parent / "all"
    names = ("kitchen/seq-01", "kitchen/seq-02", "office/seq-01", "scans/scene0000_00", "scans/scene0000_01", "me/hall")
    for name in names:
        shutil.copytree(folder, root / name)
    source = RGBDFolder(str(root))
    places = {"kitchen": 2, "office": 1, "scene0000": 2, "me/hall": 1}
    assert Counter(source.place(name) for name in names) == places
    alone = RGBDFolder(str(root / "kitchen" / "seq-02"))
    assert alone.place("seq-02") == "kitchen"


def test_shared_intrinsics_follow_the_colour_images_to_the_size_of_the_depth(write_recording):
    folder = write_recording()
    expected = RGBDFolder(str(folder)).load("office", [10]).intrinsics
    for path in (folder / "images").iterdir():
        with Image.open(path) as image:
            larger = image.resize((2 * SIZE[1], 2 * SIZE[0]))
        larger.save(path)
    matrix = np.loadtxt(folder / "K.txt")
    matrix[:2, :2] *= 2
    matrix[:2, 2] = 2 * (matrix[:2, 2] + 0.5) - 0.5
    np.savetxt(folder / "K.txt", matrix)
    frames = RGBDFolder(str(folder)).load("office", [10])
    assert frames.images.shape[-2:] == SIZE
    torch.testing.assert_close(frames.intrinsics, expected)


def test_invalid_values_become_zero(write_recording):
    folder = write_recording()
    path = folder / "depth" / "00010.png"
    stored = np.array(Image.open(path))
    stored[0, :4] = (0, 65535, 7, 2000)
    Image.fromarray(stored).save(path)
    depth = RGBDFolder(str(folder), invalid=(0, 7, 65535), depth_scale=2000).load("office", [10]).depth
    assert depth[0, 0, :4].tolist() == [0, 0, 0, 1]


def test_held_out_frames_are_targets_and_never_trained_on(rooms, write_recording):
    source = RGBDFolder(str(write_recording()), holdout=3)
    assert list(source.held_out("office")) == [11, 14]
    module = module_of(rooms, train=source, val=source, eval_context=3, eval_target=5, steps_per_epoch=40)
    trained = {frame for batch in module.train_dataloader() for frame in batch.frame_ids.flatten().tolist()}
    assert trained == {10, 12, 13, 15}
    (batch,) = module.val_dataloader()
    assert batch.target.frame_ids.tolist() == [[11, 14]]
    assert set(batch.context.frame_ids[0].tolist()) <= trained


def test_a_missing_root_names_the_path_and_the_remedy(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere.*data\.root=FOLDER"):
        RGBDFolder(str(tmp_path / "nowhere"))
    with pytest.raises(FileNotFoundError, match=r"data\.root is not set.*data\.root=FOLDER"):
        RGBDFolder(None)
    with pytest.raises(DataError, match=r"no scene in .*expected images.*; found: "):
        RGBDFolder(str(tmp_path))


def test_hololens_frames_agree_as_its_description_says(shared):
    source = RGBDFolder(str(shared / "data/hololens_office_a"))
    ids = source.frames("hololens_office_a")
    assert len(ids) == 24
    frames = source.load("hololens_office_a", ids)
    assert float((frames.depth > 0).float().mean()) == pytest.approx(0.715, abs=0.001)
    neighbours = [depth_differences(frames, a, b, stride=2)[0] for a, b in pairwise(range(24))]
    assert np.median([float(d.median()) for d in neighbours]) == pytest.approx(2.4e-3, rel=0.1)
    pairs = [depth_differences(frames, a, b, stride=3) for a in range(24) for b in range(24) if abs(a - b) >= 8]
    far = [float(differences.median()) for differences, overlap in pairs if overlap >= 0.3]
    assert np.median(far) == pytest.approx(7.2e-3, rel=0.1)
