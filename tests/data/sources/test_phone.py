"""What the round trips of phones' exports do not show: confidence, coarser depth, missing packages, damage."""

import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from vg2gt.data import DataError, RGBDFolder
from vg2gt.inputs.given_cameras import given_pictures
from vg2gt.inputs.pictures import find_pictures

from .layout_phone import write_polycam, write_r3d
from .layouts import SIZE, room, save


def as_it_is(content: bytes) -> bytes:
    """An LZFSE stream of one block that is not compressed."""
    return b"bvx-" + struct.pack("<I", len(content)) + content + b"bvx$"


def changed(path: Path, **files: bytes) -> None:
    """Exchanges files of an archive; ``__`` in a keyword stands for the folder and the dot."""
    with zipfile.ZipFile(path) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    content |= {"rgbd/" + name[1:].replace("_", ".") if name[0] == "_" else name: part for name, part in files.items()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, part in content.items():
            archive.writestr(name, part)


def test_depth_without_confidence_is_left_out(tmp_path: Path) -> None:
    pytest.importorskip("lzfse")
    write_r3d(tmp_path, room(2))
    confidence = np.full(SIZE, 1, np.uint8)
    confidence[:4] = 0
    changed(tmp_path / "sofa.r3d", _0_conf=as_it_is(confidence.tobytes()))
    source = RGBDFolder(str(tmp_path / "sofa.r3d"), holdout=None)  # the file itself
    depth = source.load("sofa.r3d", [0, 1]).depth
    assert not depth[0, :4].any()
    assert (depth[0, 4:] > 0).all()
    assert (depth[1] > 0).all()


def test_without_lzfse_colour_and_cameras_are_read_and_the_remedy_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "lzfse", FakeLzfse)
    write_r3d(tmp_path, room(2))
    monkeypatch.setitem(__import__("sys").modules, "lzfse", None)
    source = RGBDFolder(str(tmp_path), holdout=None, depth=False)
    assert source.load("sofa.r3d", [1]).images.shape[-2:] == SIZE
    with pytest.raises(ImportError, match=r"0\.depth is read with lzfse: pip install 'vg2gt\[phone\]'"):
        RGBDFolder(str(tmp_path), holdout=None).load("sofa.r3d", [0])
    for way in (tmp_path / "sofa.r3d", tmp_path):
        given = given_pictures(way)
        assert [(picture.name, picture.size, picture.has_depth) for picture in given] == [
            ("0", SIZE, False),
            ("1", SIZE, False),
        ]
    photographs = find_pictures(tmp_path / "sofa.r3d")  # for a backbone that takes no cameras
    assert [picture.read(picture.size).images.shape[-2:] for picture in photographs] == [SIZE, SIZE]


class FakeLzfse:
    """Streams that are not compressed, where the package is not installed."""

    compress = staticmethod(as_it_is)


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({"metadata": b"{"}, r"sofa\.r3d/metadata: not valid JSON"),
        ({"metadata": b"[]"}, r"sofa\.r3d/metadata: expected numbers h, w"),
        ({"metadata": b'{"h": 30, "w": 40, "dh": 99, "dw": 99}'}, r"depth of 99x99, but the images are 40x30"),
        ({"metadata": b'{"h": 30, "w": 40, "dh": 30, "dw": 40}'}, r"expected poses and intrinsics as Record3D writes"),
        ({"_0_jpg": b""}, r"cannot read .*sofa\.r3d/rgbd/0\.jpg of scene sofa\.r3d"),
        ({"_0_depth": b"bvx2"}, r"0\.depth(: damaged LZFSE data| unpacks to)"),
        ({"_0_depth": as_it_is(b"1234")}, r"0\.depth unpacks to 4 bytes, expected 4800"),
        ({"_0_conf": as_it_is(b"1")}, r"0\.conf unpacks to 1 bytes, expected 1200"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, files: dict[str, bytes], said: str) -> None:
    pytest.importorskip("lzfse")
    write_r3d(tmp_path, room(2))
    changed(tmp_path / "sofa.r3d", **files)
    with pytest.raises(DataError, match=said):
        RGBDFolder(str(tmp_path), holdout=None).load("sofa.r3d", [0])


def test_names_in_an_archive_do_not_lead_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "lzfse", FakeLzfse)
    write_r3d(tmp_path, room(1))
    (tmp_path / "1.jpg").write_bytes(b"")
    with zipfile.ZipFile(tmp_path / "sofa.r3d", "a") as archive:
        archive.writestr("rgbd/../../1.jpg", b"")
        archive.writestr("/rgbd/2.jpg", b"")
    assert RGBDFolder(str(tmp_path), holdout=None, depth=False).frames("sofa.r3d") == (0,)


def test_depth_is_coarser_and_not_to_be_trusted_everywhere(tmp_path: Path) -> None:
    frames = room(3)
    write_polycam(tmp_path, frames, corrected=False)
    folder = tmp_path / "kitchen" / "keyframes"
    for path in (folder / "depth").iterdir():
        with Image.open(path) as image:
            depth = np.array(image)[::2, ::2]
        save(path, depth)
        confidence = np.full(depth.shape, 255, np.uint8)
        confidence[:4] = 0
        save(folder / "confidence" / path.name, confidence)
    source = RGBDFolder(str(tmp_path), holdout=None)
    loaded = source.load("kitchen", source.frames("kitchen"))
    assert loaded.depth.shape == (3, SIZE[0] // 2, SIZE[1] // 2)
    assert not loaded.depth[:, :4].any()
    assert (loaded.depth[:, 4:] > 0).all()
    expected = frames.intrinsics.double().clone()
    expected[:, :2] /= 2
    expected[:, :2, 2] -= 0.25  # the middle of the first pixel is at 0, of however many it was made
    torch.testing.assert_close(loaded.intrinsics, expected.float(), atol=1e-4, rtol=0)
