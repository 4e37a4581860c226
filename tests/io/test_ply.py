"""3DGS PLY: names, order and activations byte for byte, round trips, damaged files."""

import logging
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.io.gaussian_scenes import scene
from vg2gt.io import FormatError, read_gaussian_ply, write_gaussian_ply
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
        ("background 0.25 0.5 1.5", None),
        ("background grey", None),
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


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [0, 30])
def test_header_byte_for_byte_and_round_trip(tmp_path: Path, degree: int, count: int) -> None:
    before = scene(count, degree)
    path = write_gaussian_ply(tmp_path / "scene.ply", before)
    names = BEFORE_REST + [f"f_rest_{i}" for i in range(45 if degree else 0)] + AFTER_REST
    expected, content = header(count, names), path.read_bytes()
    assert content[: len(expected)] == expected
    assert len(content) == len(expected) + count * 4 * len(names)
    after = read_gaussian_ply(path)
    assert after.sh.shape == (count, 16 if degree else 1, 3)
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
    """No normals, another order, doubles, an element after the vertices and unknown properties."""
    rng = np.random.default_rng(0)
    names = ["rot_3", "label", *AFTER_REST[:-1], *(f"f_rest_{i}" for i in reversed(range(rest)))]
    names += ["f_dc_2", "f_dc_0", "f_dc_1", "z", "x", "y"]
    values = rng.normal(size=(5, len(names)))
    column = dict(zip(names, values.T, strict=True))
    head = header(5, names, "double").replace(
        b"end_header", b"comment by hand\nelement face 2\nproperty list uchar int vertex_indices\nend_header"
    )
    path = tmp_path / "other.ply"
    path.write_bytes(head + values.astype("<f8").tobytes() + b"\0" * 2)
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


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"ply\nformat binary_little_endian 1.0\n", "not a PLY file"),
        (b"ply\nelement vertex 0\nproperty float x\nend_header\n", "line 2 of the header"),
        (b"ply\nformat binary_little_endian 1.0\nelement face 0\nend_header\n", "begin with binary vertices"),
        (b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n", "line 2 of the header: .* binary vertices"),
        (b"ply\nformat binary_big_endian 1.0\nelement vertex -1\nend_header\n", "line 3 of the header: unexpected"),
        (header(0, ["x"], "quad"), "line 4 of the header: unexpected 'property quad x'"),
        (header(0, ["x", "x"]), "line 5 of the header: unexpected"),
        (header(0, []), "no vertices"),
        (header(0, ["x"], "list uchar int"), "line 4 of the header"),
        (header(9 * 10**17, ["x", "y", "z"]), "need 10800000000000000000 bytes, 0 are left"),
        (header(3, ["x", "y", "z"]) + b"\0" * 35, "need 36 bytes, 35 are left"),
        (header(0, ["x", "y", "z"]), "vertices have no f_dc_0, f_dc_1, f_dc_2, only x, y, z"),
        (header(0, ["x", "packed_position"]), "splat-transform"),
        (b"ply\nformat binary_little_endian 1.0\nelement chunk 178\nend_header\n", "compressed PLY; splat-transform"),
        (header(0, [*BEFORE_REST, *(f"f_rest_{i}" for i in range(10)), *AFTER_REST]), "10 f_rest properties, expected"),
    ],
)
def test_damage_is_named(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "scene.ply"
    path.write_bytes(content)
    with pytest.raises(FormatError, match=message) as caught:
        read_gaussian_ply(path)
    assert str(path) in str(caught.value)


def test_2dgs_is_read_as_flat_and_big_endian_is_read(tmp_path: Path) -> None:
    """Item 22."""
    before, path = scene(7, 1), tmp_path / "scene.ply"
    head, body = write_gaussian_ply(path, before).read_bytes().split(b"end_header\n", 1)
    table = np.frombuffer(body, "<f4").reshape(7, -1)
    path.write_bytes(head.replace(b"little", b"big") + b"end_header\n" + table.astype(">f4").tobytes())
    assert_same(read_gaussian_ply(path), before)
    without = np.delete(table, table.shape[1] - 5, 1)  # scale_2, before four of the rotation
    path.write_bytes(head.replace(b"property float scale_2\n", b"") + b"end_header\n" + without.tobytes())
    read = read_gaussian_ply(path)
    torch.testing.assert_close(read.scales[:, :2], before.scales[:, :2])
    torch.testing.assert_close(read.scales[:, 2], 0.01 * before.scales[:, :2].min(1).values)
    assert torch.equal(read.means, before.means)
