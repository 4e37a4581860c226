"""3DGS and point PLY: names, order and activations byte for byte, round trips, damaged files."""

import logging
import struct
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import torch

from tests.io.gaussian_scenes import scene
from vg2gt.geometry.spherical_harmonics import DC
from vg2gt.io import (
    FormatError,
    read_gaussian_ply,
    read_point_ply,
    write_compressed_ply,
    write_gaussian_ply,
    write_point_ply,
)
from vg2gt.io.ply_container import ply_content, read_elements, read_vertices
from vg2gt.types import Gaussians

BEFORE_REST = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
AFTER_REST = ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def header(count: int, names: list[str], kind: str = "float") -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    return "\n".join([*lines, *(f"property {kind} {name}" for name in names), "end_header", ""]).encode()


def assert_same(read: Gaussians, written: Gaussians) -> None:
    """Copied columns exactly; activated ones to the rounding of a float32 logarithm or logit."""
    assert torch.equal(read.means, written.means)
    assert torch.equal(read.quats, written.quats)
    assert torch.equal(read.sh[:, : written.sh.shape[1]], written.sh)
    assert (read.sh[:, written.sh.shape[1] :] == 0).all()
    torch.testing.assert_close(read.scales, written.scales, rtol=1e-6, atol=0)
    torch.testing.assert_close(read.opacities, written.opacities, rtol=2e-6, atol=0)
    assert torch.equal(read.batch, written.batch)


@pytest.mark.parametrize(
    ("comment", "background"),
    [
        ("background 0.25 0.5 1", [[0.25, 0.5, 1.0]]),
        ("background 0.25 0.5", None),
        ("background 0.25 0.5 1.5", None),
        ("background grey", None),
        ("made by somebody 0.25 0.5 1", None),
    ],
)
def test_the_colour_behind_a_scene(tmp_path: Path, comment: str, background: list[list[float]] | None) -> None:
    behind = torch.tensor([[0.25, 0.5, 1.0]])
    path = write_gaussian_ply(tmp_path / "scene.ply", replace(scene(3, 0), background=behind))
    content = path.read_bytes()
    assert b"\ncomment background 0.25 0.5 1\n" in content
    path.write_bytes(content.replace(b"background 0.25 0.5 1", comment.encode()))
    found = read_gaussian_ply(path)
    assert len(found) == 3
    assert (found.background if found.background is None else found.background.tolist()) == background


@pytest.mark.parametrize(("degree", "full"), [(0, False), (0, True), (1, False), (2, False), (3, False)])
@pytest.mark.parametrize("count", [0, 1, 300])
def test_header_byte_for_byte_and_round_trip(tmp_path: Path, degree: int, full: bool, count: int) -> None:
    before = scene(count, degree)
    path = write_gaussian_ply(tmp_path / "scene.ply", before, full_sh=full)
    names = BEFORE_REST + [f"f_rest_{i}" for i in range(45 if degree or full else 0)] + AFTER_REST
    expected, content = header(count, names), path.read_bytes()
    assert content[: len(expected)] == expected
    assert len(content) == len(expected) + count * 4 * len(names)
    after = read_gaussian_ply(path)
    assert after.sh.shape == (count, 16 if degree or full else 1, 3)
    assert_same(after, before)
    assert all(tensor.dtype == torch.float32 for tensor in (after.means, after.scales, after.sh))


def test_activations_and_channel_order(tmp_path: Path) -> None:
    one = scene(1, 3)
    content = write_gaussian_ply(tmp_path / "scene.ply", one).read_bytes()
    row = struct.unpack("<62f", content[-62 * 4 :])
    assert (row[:3], row[3:6]) == (tuple(one.means[0].tolist()), (0, 0, 0))
    assert row[6:9] == tuple(one.sh[0, 0].tolist())
    for channel in range(3):
        assert row[9 + 15 * channel : 24 + 15 * channel] == tuple(one.sh[0, 1:, channel].tolist())
    opacity = one.opacities.double().item()
    assert row[54] == np.float32(np.log(opacity / (1 - opacity)))
    assert row[55:58] == tuple(np.log(one.scales[0].double().numpy()).astype(np.float32))
    assert row[58:] == tuple(one.quats[0].tolist())


def test_cut_opacities_stay_finite(tmp_path: Path) -> None:
    two = replace(scene(2), opacities=torch.tensor([0.0, 1.0]))
    path = write_gaussian_ply(tmp_path / "scene.ply", two)
    assert np.isfinite(np.frombuffer(path.read_bytes()[-17 * 8 :], "<f4")).all()
    after = read_gaussian_ply(path).opacities
    assert 0 < after[0] < 1e-7
    assert 1 - 1e-7 < after[1] < 1
    assert two.opacities.tolist() == [0.0, 1.0]


@pytest.mark.parametrize("rest", [0, 9, 24, 45])
def test_other_writers_files(tmp_path: Path, rest: int) -> None:
    """No normals, another order, doubles, an element before the vertices and unknown properties."""
    rng = np.random.default_rng(0)
    names = ["rot_3", "label", *AFTER_REST[:-1], *(f"f_rest_{i}" for i in reversed(range(rest)))]
    names += ["f_dc_2", "f_dc_0", "f_dc_1", "z", "x", "y"]
    values = rng.normal(size=(5, len(names)))
    column = dict(zip(names, values.T, strict=True))
    head = header(5, names, "double").replace(
        b"element vertex", b"comment by hand\nelement note 2\nproperty uchar u\nproperty short s\nelement vertex"
    )
    path = tmp_path / "other.ply"
    path.write_bytes(head + b"\0" * 6 + values.astype("<f8").tobytes())
    read = read_gaussian_ply(path)
    np.testing.assert_allclose(read.means.numpy(), np.stack([column[n] for n in "xyz"], -1), rtol=1e-6)
    np.testing.assert_allclose(read.scales.numpy()[:, 1], np.exp(column["scale_1"]), rtol=1e-6)
    np.testing.assert_allclose(read.opacities.numpy(), 1 / (1 + np.exp(-column["opacity"])), rtol=1e-6)
    coefficients = rest // 3
    assert read.sh.shape == (5, coefficients + 1, 3)
    for channel in range(3):
        np.testing.assert_allclose(read.sh[:, 0, channel].numpy(), column[f"f_dc_{channel}"], rtol=1e-6)
        for k in range(coefficients):
            expected = column[f"f_rest_{channel * coefficients + k}"]
            np.testing.assert_allclose(read.sh[:, k + 1, channel].numpy(), expected, rtol=1e-6)


def test_rows_that_are_no_gaussians_are_left_out_and_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write_gaussian_ply(tmp_path / "scene.ply", scene(5))
    content = path.read_bytes()
    table = np.frombuffer(content[-5 * 17 * 4 :], "<f4").reshape(5, 17).copy()
    table[0, 0] = np.nan
    table[1, 13:] = 0  # quaternion
    table[2, 10] = 200  # scale overflows
    table[3, 10] = -200  # scale vanishes
    table[4, 12] = -np.inf  # what other programs write for a flat side
    path.write_bytes(content[: -5 * 17 * 4] + table.tobytes())
    with caplog.at_level(logging.WARNING):
        read = read_gaussian_ply(path)
    assert "3 of 5 Gaussians" in caplog.text
    assert read.scales[0, 0] == read.scales[1, 2] == np.float32(1e-10)
    assert len(read_gaussian_ply(write_gaussian_ply(path, read))) == 2


def test_what_cannot_be_written_is_named(tmp_path: Path) -> None:
    good = scene(3)
    path = tmp_path / "scene.ply"
    bad = {
        "one scene": replace(good, batch=torch.tensor([0, 0, 1])),
        "means has 1 values": replace(good, means=good.means.clone()),
        "scales must be positive": replace(good, scales=good.scales - 10),
        "not logits": replace(good, opacities=good.opacities + 5),
        r"sh must be": replace(good, sh=good.sh.repeat(1, 2, 1)),
    }
    bad["means has 1 values"].means[1, 1] = torch.nan
    for message, gaussians in bad.items():
        with pytest.raises(ValueError, match=message):
            write_gaussian_ply(path, gaussians)
    assert not path.exists()


@pytest.mark.parametrize("count", [0, 1, 200])
@pytest.mark.parametrize("colored", [True, False])
def test_points_round_trip(tmp_path: Path, count: int, colored: bool) -> None:
    rng = np.random.default_rng(0)
    xyz = rng.normal(size=(count, 3)).astype(np.float32)
    rgb = rng.integers(0, 256, (count, 3)).astype(np.uint8) if colored else None
    path = write_point_ply(tmp_path / "points.ply", xyz, rgb)
    names = b"".join(b"property uchar %s\n" % name for name in (b"red", b"green", b"blue")) if colored else b""
    expected = header(count, ["x", "y", "z"]).replace(b"end_header", names + b"end_header")
    assert path.read_bytes()[: len(expected)] == expected
    read = read_point_ply(path)
    np.testing.assert_array_equal(read.positions, xyz)
    assert (read.positions.dtype, read.colors is None) == (np.float32, rgb is None)
    np.testing.assert_array_equal(read.colors, rgb)


def test_ascii_points_with_faces(tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    places, colors = (
        "".join(f"property {kind} {name}\n" for name in names.split())
        for kind, names in (("double", "x y z"), ("uchar", "red green blue"))
    )
    faces = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    text = f"ply\nformat ascii 1.0\nelement vertex 2\n{places}{colors}{faces}0.1 2 3 255 0 1\n4 5 6 7 8 9\n3 0 1 0\n"
    path.write_bytes(text.replace("\n", "\r\n").encode())
    read = read_point_ply(path)
    assert read.positions.tolist() == [[0.1, 2.0, 3.0], [4.0, 5.0, 6.0]]
    assert read.colors.tolist() == [[255, 0, 1], [7, 8, 9]]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"ply\nformat binary_little_endian 1.0\n", "not a PLY file"),
        (b"ply\nelement vertex 0\nproperty float x\nend_header\n", "no line 'format'"),
        (b"ply\nformat ascii 1.0\nelement face 0\nend_header\n", "no element vertex, only face"),
        (b"ply\nformat ascii 1.0\nelement vertex -1\nend_header\n", "line 3 of the header: unexpected"),
        (header(0, ["x"], "quad"), "expected 'property TYPE NAME'"),
        (header(9 * 10**17, ["x", "y", "z"]), "need 10800000000000000000 bytes, 0 are left"),
        (header(0, ["x", "y"]), "vertices have no z, only x, y"),
        (header(3, ["x", "y", "z"]) + b"\0" * 35, "need 36 bytes, 35 are left"),
        (header(1, ["x", "y", "z"]).replace(b"binary_little_endian", b"ascii") + b"1 2\n", "vertex 0 has 2 numbers"),
        (header(1, ["x", "y", "z"]).replace(b"binary_little_endian", b"ascii") + b"1 2 a\n", "not a number"),
    ],
)
def test_damage_is_named(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "points.ply"
    path.write_bytes(content)
    with pytest.raises(FormatError, match=message) as caught:
        read_point_ply(path)
    assert str(path) in str(caught.value)


def test_gaussian_reader_names_what_is_missing(tmp_path: Path) -> None:
    path = write_point_ply(tmp_path / "points.ply", np.zeros((2, 3)))
    with pytest.raises(FormatError, match="vertices have no f_dc_0, f_dc_1, f_dc_2, only x, y, z"):
        read_gaussian_ply(path)
    names = [*BEFORE_REST, *(f"f_rest_{i}" for i in range(10)), *AFTER_REST]
    path.write_bytes(header(0, names))
    with pytest.raises(FormatError, match="10 f_rest properties, expected 0, 9, 24 or 45"):
        read_gaussian_ply(path)


def table_of(gaussians) -> np.ndarray:
    """The vertices of a 3DGS file, to be written otherwise."""
    with TemporaryDirectory() as folder:
        return read_vertices(write_gaussian_ply(Path(folder) / "scene.ply", gaussians)).copy()


def test_2dgs_is_read_as_flat(tmp_path: Path) -> None:
    """Item 22."""
    before = scene(7, 1)
    table = table_of(before)
    names = [name for name in table.dtype.names or () if name != "scale_2"]
    flat = table[names].astype([(name, "<f4") for name in names])
    (tmp_path / "scene.ply").write_bytes(ply_content({"vertex": flat}))
    read = read_gaussian_ply(tmp_path / "scene.ply")
    torch.testing.assert_close(read.scales[:, :2], before.scales[:, :2])
    torch.testing.assert_close(read.scales[:, 2], 0.01 * before.scales[:, :2].min(1).values)
    torch.testing.assert_close(read.means, before.means)


def test_big_endian_is_read(tmp_path: Path) -> None:
    """Item 22."""
    table = table_of(scene(7, 1))
    swapped = table.astype(table.dtype.newbyteorder(">"))
    head = ply_content({"vertex": table[:0]}).replace(b"little", b"big").replace(b"vertex 0", b"vertex 7")
    (tmp_path / "scene.ply").write_bytes(head + swapped.tobytes())
    little = write_gaussian_ply(tmp_path / "little.ply", scene(7, 1))
    one, other = (vars(read_gaussian_ply(path)).values() for path in (tmp_path / "scene.ply", little))
    assert all(a is b is None or torch.equal(a, b) for a, b in zip(one, other, strict=True))


def test_compressed_files_without_bounds_of_colours_are_read(tmp_path: Path) -> None:
    """Item 22: older ones of SuperSplat, whose colours lie in [0, 1]; held to the program in test_clients.py."""
    before = scene(600, 1)
    before.sh[:, 0] = (torch.rand(600, 3, generator=torch.Generator().manual_seed(0)).round() - 0.5) / DC
    path = write_compressed_ply(tmp_path / "scene.compressed.ply", before)
    whole, elements = read_gaussian_ply(path), read_elements(path, "chunk", "vertex", "sh")
    names = [name for name in elements["chunk"].dtype.names or () if name[-1] not in "rgb"]
    chunk = np.stack([elements["chunk"][name] for name in names], 1).view([(name, "<f4") for name in names])[:, 0]
    path.write_bytes(ply_content({**elements, "chunk": chunk}))
    read = read_gaussian_ply(path)
    for name in ("means", "scales", "quats", "opacities", "sh"):
        torch.testing.assert_close(getattr(read, name), getattr(whole, name))
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(FormatError, match="truncated"):
        read_gaussian_ply(path)
