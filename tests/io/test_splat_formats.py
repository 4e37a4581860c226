"""Formats of Gaussians other than PLY: layout, stated losses, what cannot be written or read."""

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
from vg2gt.geometry.spherical_harmonics import DC, basis
from vg2gt.io import FormatError, read_gaussians, write_gaussians, write_glb
from vg2gt.types import Gaussians

# Stated in the modules: absolute error of positions, log-scales, opacities, colours, rotations, higher coefficients.
LOSSES = {
    "spz": (2e-6, 1 / 31, 1 / 509, 1 / 134, 1 / 350, 1 / 255),
    "compressed.ply": (2e-3, 8e-3, 1 / 509, 1 / 100, 1 / 350, 1 / 63),
    "glb": (0, 1e-6, 0, 0, 1e-6, 0),
    "splat": (0, 0, 1 / 509, 1 / 509, 1 / 120, 0),  # of degree 0, colours in [0, 1]
}


def mild(count: int, degree: int) -> Gaussians:
    """Colours within what all formats hold."""
    gaussians = scene(count, degree)
    return replace(gaussians, sh=torch.tanh(gaussians.sh))


def ordered(gaussians: Gaussians, like: Gaussians) -> Gaussians:
    """In the order of others: nearest means."""
    rows = torch.cdist(like.means.double(), gaussians.means.double()).argmin(1)
    assert len(rows.unique()) == len(like) == len(gaussians)
    return gaussians.select(rows)


@pytest.mark.parametrize(
    ("suffix", "degree"), [(suffix, degree) for suffix in LOSSES for degree in range(1 if suffix == "splat" else 4)]
)
def test_round_trip_within_the_stated_losses(tmp_path: Path, suffix: str, degree: int) -> None:
    before = mild(700, degree)
    if suffix == "splat":
        before = replace(before, sh=(before.sh / 2) / DC)
    path = write_gaussians(tmp_path / f"scene.{suffix}", before)
    after = ordered(read_gaussians(path), before)
    position, scales, opacity, color, rotation, rest = LOSSES[suffix]
    torch.testing.assert_close(after.means, before.means, rtol=0, atol=position)
    torch.testing.assert_close(after.scales.log(), before.scales.log(), rtol=0, atol=scales)
    torch.testing.assert_close(after.opacities, before.opacities, rtol=0, atol=opacity)
    assert after.sh.shape == before.sh.shape
    torch.testing.assert_close(after.sh[:, 0] * DC, before.sh[:, 0] * DC, rtol=0, atol=color)
    torch.testing.assert_close(after.sh[:, 1:], before.sh[:, 1:], rtol=0, atol=rest)
    units = [F.normalize(gaussians.quats.double(), dim=-1) for gaussians in (before, after)]
    sign = (units[0] * units[1]).sum(-1, keepdim=True).sign()
    assert (units[0] - sign * units[1]).abs().max() <= rotation
    again = write_gaussians(tmp_path / f"again.{suffix}", before)
    assert again.read_bytes() == path.read_bytes()  # nothing of the time or the name


@pytest.mark.parametrize(("suffix", "most"), [("spz", 20), ("compressed.ply", 17), ("ply", 69), ("splat", 32)])
def test_scenes_of_nothing_and_of_one_and_small_files(tmp_path: Path, suffix: str, most: int) -> None:
    path = tmp_path / f"scene.{suffix}"
    for count in (0, 1):
        assert len(read_gaussians(write_gaussians(path, scene(count)))) == count
    assert write_gaussians(path, scene(5000)).stat().st_size / 5000 <= most


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
    data = gzip.decompress(write_gaussians(tmp_path / "a.spz", one).read_bytes())
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


def test_splat_by_its_layout(tmp_path: Path) -> None:
    one = replace(
        scene(1),
        quats=torch.tensor([[0.0, 0, -2, 0]]),
        opacities=torch.tensor([1.0]),
        sh=torch.tensor([[[(1 - 0.5) / DC, (0.2 - 0.5) / DC, -9.0]]]),
    )
    content = write_gaussians(tmp_path / "scene.splat", one).read_bytes()
    assert struct.unpack("<6f", content[:24]) == (*one.means[0].tolist(), *one.scales[0].tolist())
    assert list(content[24:]) == [255, 51, 0, 255, 128, 128, 0, 128]


def test_damage_of_splat_is_named(tmp_path: Path) -> None:
    path = write_gaussians(tmp_path / "scene.splat", scene(3))
    content = path.read_bytes()
    path.write_bytes(content[:-1])
    with pytest.raises(FormatError, match=r"scene\.splat: 95 bytes are not a multiple of 32"):
        read_gaussians(path)
    path.write_bytes(content[:44] + struct.pack("<f", -1.0) + content[48:])
    with pytest.raises(FormatError, match=r"byte 32: scales .* are negative"):
        read_gaussians(path)
    with pytest.raises(ValueError, match="quats must have nonzero norm"):
        write_gaussians(path, replace(scene(3), quats=torch.zeros(3, 4)))


def test_colours_turn_with_the_axes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What another program reads: colours along a direction in its axes are ours along that direction in ours."""
    before = mild(50, 3)
    path = write_gaussians(tmp_path / "a.glb", before)
    monkeypatch.setattr("vg2gt.io.gaussian_glb.upright", lambda arrays: arrays)
    theirs = read_gaussians(path)
    direction = F.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    turned = direction * torch.tensor([1.0, -1, -1])
    shown = [(basis(d, 3)[..., None] * g.sh).sum(1) for d, g in ((direction, before), (turned, theirs))]
    torch.testing.assert_close(shown[1], shown[0], rtol=0, atol=1e-5)
    torch.testing.assert_close(theirs.means, before.means * torch.tensor([1.0, -1, -1]))


def test_spz_of_version_2_and_of_far_positions_is_read_and_other_files_are_named(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    body = bytes([0, 16, 0, 0, 240, 255, 0, 0, 0]) + bytes([128, 128, 0, 255, 160, 160, 160]) + bytes([255, 128, 128])
    path.write_bytes(gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 2, 1, 0, 12, 0, 0) + body))
    read = read_gaussians(path)
    torch.testing.assert_close(read.means, torch.tensor([[1.0, -1.0, 0.0]]))
    torch.testing.assert_close(read.scales, torch.ones(1, 3))
    torch.testing.assert_close(read.quats[0].abs(), torch.tensor([0.0, 1, 0, 0]), rtol=0, atol=0.01)
    for content, said in (
        (b"NGSP" + bytes(40), "version 4.*splat-transform"),
        (b"hello", "not a .spz"),
        (gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 5, 0, 12, 0, 0)), "5 Gaussians need 100 bytes, found 0"),
    ):
        path.write_bytes(content)
        with pytest.raises(FormatError, match=said):
            read_gaussians(path)
    with pytest.raises(ValueError, match="8 million"):
        write_gaussians(path, replace(scene(1), means=torch.full((1, 3), 1e8)))
    far = replace(scene(5), means=scene(5).means * 1e4)
    after = read_gaussians(write_gaussians(path, far))
    torch.testing.assert_close(after.means, far.means, rtol=0, atol=40000 / 2**22)


def test_glb_is_what_the_extension_says(tmp_path: Path) -> None:
    path = write_gaussians(tmp_path / "a.glb", replace(mild(3, 1), quats=torch.tensor([[2.0, 0, 0, 0]] * 3)))
    content = path.read_bytes()
    size = struct.unpack("<I", content[12:16])[0]
    gltf = json.loads(content[20 : 20 + size])
    assert len(content) == struct.unpack("<I", content[8:12])[0]
    primitive = gltf["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"] == {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
    }
    assert gltf["extensionsUsed"] == ["KHR_gaussian_splatting"]
    own = {f"KHR_gaussian_splatting:{name}" for name in ("ROTATION", "SCALE", "OPACITY")}
    own |= {f"KHR_gaussian_splatting:SH_DEGREE_{d}_COEF_{i}" for d, most in ((0, 1), (1, 3)) for i in range(most)}
    assert set(primitive["attributes"]) == {"POSITION", "COLOR_0"} | own
    accessor = gltf["accessors"][primitive["attributes"]["KHR_gaussian_splatting:ROTATION"]]
    start = 28 + size + gltf["bufferViews"][accessor["bufferView"]]["byteOffset"]
    assert np.frombuffer(content, "<f4", 4, start).tolist() == [0, 0, 0, 1]  # x y z w, a unit
    with pytest.raises(ValueError, match="at least one Gaussian"):
        write_gaussians(tmp_path / "none.glb", scene(0))
    write_glb(tmp_path / "points.glb", torch.rand(4, 3).numpy())
    with pytest.raises(FormatError, match="no Gaussians"):
        read_gaussians(tmp_path / "points.glb")
    gltf["nodes"][0]["scale"] = [2, 2, 2]
    text = json.dumps(gltf).encode()
    path.write_bytes(content[:12] + struct.pack("<I", len(text)) + content[16:20] + text + content[20 + size :])
    with pytest.raises(FormatError, match="a node moves"):
        read_gaussians(path)


def test_names_decide(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"\.ply, \.splat, \.spz, \.glb"):
        write_gaussians(tmp_path / "a.txt", scene(1))
    with pytest.raises(ValueError, match="expected a scene of Gaussians"):
        read_gaussians(tmp_path / "a.txt")
    with pytest.raises(FileNotFoundError, match="no scene"):
        read_gaussians(tmp_path / "a.spz")
