"""SPZ: layout, stated losses, what cannot be written or read. Readers by suffix, tiles."""

import gzip
import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from tests.io.gaussian_scenes import scene
from vg2gt.geometry.spherical_harmonics import DC
from vg2gt.io import FormatError, read_gaussians, read_spz, write_gaussian_ply, write_spz, write_tiles
from vg2gt.types import Gaussians


def mild(count: int, degree: int) -> Gaussians:
    """Colours within what SPZ holds."""
    gaussians = scene(count, degree)
    return replace(gaussians, sh=torch.tanh(gaussians.sh))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_round_trip_within_the_stated_losses(tmp_path: Path, degree: int) -> None:
    before = mild(700, degree)
    path = write_spz(tmp_path / "scene.spz", before)
    after = read_gaussians(path)
    torch.testing.assert_close(after.means, before.means, rtol=0, atol=2e-6)
    torch.testing.assert_close(after.scales.log(), before.scales.log(), rtol=0, atol=1 / 31)
    torch.testing.assert_close(after.opacities, before.opacities, rtol=0, atol=1 / 509)
    torch.testing.assert_close(after.sh[:, 0] * DC, before.sh[:, 0] * DC, rtol=0, atol=1 / 134)
    torch.testing.assert_close(after.sh[:, 1:], before.sh[:, 1:], rtol=0, atol=1 / 255)
    units = [F.normalize(gaussians.quats.double(), dim=-1) for gaussians in (before, after)]
    sign = (units[0] * units[1]).sum(-1, keepdim=True).sign()
    assert (units[0] - sign * units[1]).abs().max() <= 1 / 350
    assert write_spz(tmp_path / "again.spz", before).read_bytes() == path.read_bytes()  # nothing of the time or name
    flagged = write_spz(tmp_path / "flagged.spz", before, antialiased=True)
    plain, said = (gzip.decompress(each.read_bytes()) for each in (path, flagged))
    assert (plain[14], said[14]) == (0, 1)  # the format's flag byte
    assert plain[:14] + plain[15:] == said[:14] + said[15:]


def test_scenes_of_nothing_and_of_one_and_small_files(tmp_path: Path) -> None:
    path = tmp_path / "scene.spz"
    for count in (0, 1):
        assert len(read_spz(write_spz(path, scene(count)))) == count
    assert write_spz(path, scene(5000)).stat().st_size / 5000 <= 20


def test_spz_by_its_published_layout(tmp_path: Path) -> None:
    """Decoded byte by byte: one Gaussian, quarter turn about y."""
    half = 0.5**0.5
    one = replace(
        mild(1, 1),
        means=torch.tensor([[1.0, 2.0, -3.0]]),
        quats=torch.tensor([[half, 0, half, 0]]),
        scales=torch.tensor([[1.0, 0.5, np.exp(-10)]]),
        opacities=torch.tensor([1.0]),
        sh=torch.tensor([[[0.0, 1.0, -9.0], [0.5, 0, 0], [0, 0.25, 0], [0, 0, -2.0]]]),
    )
    data = gzip.decompress(write_spz(tmp_path / "a.spz", one).read_bytes())
    magic, version, count, degree, bits, flags, reserved = struct.unpack("<4sIIBBBB", data[:16])
    assert (magic, version, count, degree, flags, reserved) == (b"NGSP", 3, 1, 1, 0, 0)
    position = [int.from_bytes(data[i : i + 3], "little", signed=True) / 2**bits for i in (16, 19, 22)]
    assert position == [1, 2, -3]
    assert list(data[25:32]) == [255, 128, 166, 0, 160, 149, 0]
    word = struct.unpack("<I", data[32:36])[0]
    assert word >> 30 in (1, 3)  # y or w, which are equal
    assert [word >> shift & 511 for shift in (20, 10, 0)] in ([0, 0, 511], [0, 511, 0])
    assert [word >> shift & 512 for shift in (20, 10, 0)].count(512) == 0
    assert list(data[36:]) == [192, 128, 128, 128, 160, 128, 128, 128, 0]


def test_version_2_is_read_far_positions_are_kept_and_other_files_are_named(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    body = bytes([0, 16, 0, 0, 240, 255, 0, 0, 0]) + bytes([128, 128, 0, 255, 160, 160, 160]) + bytes([255, 128, 128])
    path.write_bytes(gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 2, 1, 0, 12, 0, 0) + body))
    read = read_spz(path)
    torch.testing.assert_close(read.means, torch.tensor([[1.0, -1.0, 0.0]]))
    torch.testing.assert_close(read.scales, torch.ones(1, 3))
    torch.testing.assert_close(read.quats[0].abs(), torch.tensor([0.0, 1, 0, 0]), rtol=0, atol=0.01)
    for content, said in (
        (b"NGSP" + bytes(40), "version 2 or 3.*splat-transform"),
        (gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 1, 0, 0, 12, 0, 0)), "version 2 or 3 .*, got b'NGSP' 1"),
        (gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 5, 0, 12, 0, 0)), "5 Gaussians need 100 bytes, found 0"),
        (gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 0, 4, 12, 0, 0)), "degree 4"),
    ):
        path.write_bytes(content)
        with pytest.raises(FormatError, match=said):
            read_spz(path)
    with pytest.raises(ValueError, match="8 million"):
        write_spz(path, replace(scene(1), means=torch.full((1, 3), 1e8)))
    with pytest.raises(ValueError, match="quats must have nonzero norm"):
        write_spz(path, replace(scene(3), quats=torch.zeros(3, 4)))
    far = replace(scene(5), means=scene(5).means * 1e4)
    after = read_spz(write_spz(path, far))
    torch.testing.assert_close(after.means, far.means, rtol=0, atol=40000 / 2**22)


def test_suffixes_decide(tmp_path: Path) -> None:
    assert len(read_gaussians(write_gaussian_ply(tmp_path / "a.PLY", scene(2)))) == 2
    with pytest.raises(ValueError, match=r"expected a scene of Gaussians, \.ply, \.spz, \.glb, \.gltf"):
        read_gaussians(tmp_path / "a.splat")
    with pytest.raises(FileNotFoundError, match=r"a\.spz"):
        read_gaussians(tmp_path / "a.spz")


def test_tiles_hold_every_gaussian_once_and_say_where(tmp_path: Path) -> None:
    means = torch.rand(1000, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([8.0, 2.0, 3.0])
    write_tiles(tmp_path, replace(scene(1000), means=means, background=torch.tensor([[0.5, 0, 1]])), most=130)
    index = json.loads((tmp_path / "index.json").read_text())
    assert (index["gaussians"], index["background"]) == (1000, [0.5, 0, 1])
    assert len(index["tiles"]) == 8
    parts = [read_gaussians(tmp_path / tile["file"]).means for tile in index["tiles"]]
    assert [len(part) for part in parts] == [tile["gaussians"] for tile in index["tiles"]]
    assert max(map(len, parts)) <= 130
    boxes = torch.tensor([[tile["low"], tile["high"]] for tile in index["tiles"]])
    assert (boxes[:, 1] - boxes[:, 0]).prod(1).sum() <= 8 * 2 * 3  # they hardly overlap
    for part, (low, high) in zip(parts, boxes, strict=True):
        torch.testing.assert_close(
            torch.stack((part.amin(0), part.amax(0))), torch.stack((low, high)), atol=1e-5, rtol=0
        )
    back = torch.cat(parts)
    torch.testing.assert_close(back[back[:, 0].argsort()], means[means[:, 0].argsort()], atol=1e-5, rtol=0)
