"""ScanNet's own traps: unpadded numbers, lost poses, two sizes of images, several scans of one room; raw streams."""

import struct
import zlib

import numpy as np
import pytest
import torch

from examples.data_sets.scannet_sens import ScanNetSens
from vg2gt.data import DataError, RGBDFolder
from vg2gt.data.sources import ScanNet

from .layout_scannet import sens_frame, sens_header, write_export, write_sens
from .layouts import millimetres, pixels, room

SCENE = "scene0707_00"


@pytest.mark.parametrize("loader", [ScanNet, RGBDFolder])
def test_frames_are_sorted_by_number_and_lost_ones_left_out(tmp_path, caplog, loader):
    write_export(tmp_path, room(4))
    np.savetxt(tmp_path / "scans" / SCENE / "pose" / "9.txt", np.full((4, 4), -np.inf))
    source = loader(str(tmp_path / "scans"))
    assert source.frames(SCENE) == (8, 10, 11)
    assert "1 of 4 frames whose pose is not finite are left out" in caplog.text
    assert torch.allclose(source.load(SCENE, [10]).world_to_camera[0], room(4).world_to_camera[2], atol=1e-6)


def test_scans_of_one_room_show_one_place(tmp_path):
    for scene in (SCENE, "scene0707_01", "scene0706_00"):
        write_export(tmp_path, room(4), scene)
    source = ScanNet(str(tmp_path))
    assert source.scenes == ("scene0706_00", SCENE, "scene0707_01")
    assert [source.place(scene) for scene in source.scenes] == ["scene0706", "scene0707", "scene0707"]
    assert ScanNet(str(tmp_path / "scans" / SCENE)).scenes == (SCENE,)


def test_a_stream_holds_what_its_export_does(tmp_path):
    path = write_sens(tmp_path / "raw", room(4), lost=1)
    write_export(tmp_path / "exported", room(4))
    raw, exported = ScanNetSens(str(tmp_path / "raw")), ScanNet(str(tmp_path / "exported"))
    assert raw.scenes == exported.scenes == ScanNetSens(str(path.parent)).scenes == (SCENE,)
    assert (raw.place(SCENE), raw.frames(SCENE)) == ("scene0707", (0, 2, 3))
    ours, theirs = raw.load(SCENE, [3, 0]), exported.load(SCENE, [11, 8])
    assert torch.equal(ours.images, theirs.images)
    assert torch.equal(ours.depth, theirs.depth)
    assert torch.allclose(ours.world_to_camera, theirs.world_to_camera, atol=1e-6)
    assert torch.allclose(ours.intrinsics, theirs.intrinsics, atol=1e-4)


def test_depth_that_expands_without_end_is_refused(tmp_path):
    packed = zlib.compress(bytes(1 << 26))
    frame = sens_frame(pixels(room(4))[0], millimetres(room(4))[0], np.eye(4), True, True)
    color_length, depth_length = struct.unpack("<2Q", frame[80:96])
    frame = frame[:88] + struct.pack("<Q", len(packed)) + frame[96 : 96 + color_length] + packed
    path = tmp_path / f"{SCENE}.sens"
    path.write_bytes(sens_header(room(4), 1, 2, 1) + frame)
    assert depth_length != len(packed)
    with pytest.raises(DataError, match=rf"frame 0 in .*{SCENE}\.sens of scene {SCENE} is not of 40x30 pixels"):
        ScanNetSens(str(tmp_path)).load(SCENE, [0])
