"""Gaussians in glTF: the layout of KHR_gaussian_splatting, what others write, what cannot be read."""

import base64
import gzip
import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from tests.io.gaussian_scenes import scene, views
from vg2gt.geometry.spherical_harmonics import DC
from vg2gt.io import FormatError, read_gaussian_gltf, read_gaussians, write_gaussian_gltf, write_mesh
from vg2gt.io.mesh import Mesh
from vg2gt.rendering import Renderer
from vg2gt.types import Gaussians

NAME = "KHR_gaussian_splatting"


def chunks(path: Path) -> tuple[dict, bytes]:
    """JSON and binary values of a ``.glb``."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert (kind, size % 4) == (b"JSON", 0)
    length, tail = struct.unpack_from("<I4s", data, 20 + size)
    assert (tail, length % 4, 28 + size + length) == (b"BIN\0", 0, len(data))
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def colors(gaussians: Gaussians) -> torch.Tensor:
    return Renderer(mode="rasterized")(gaussians, views()).color


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("name", ["scene.glb", "scene.gltf"])
def test_round_trip(tmp_path: Path, degree: int, name: str) -> None:
    before = scene(40, degree)
    after = read_gaussians(write_gaussian_gltf(tmp_path / name, before))
    for field in ("means", "scales", "opacities"):
        torch.testing.assert_close(getattr(after, field), getattr(before, field), atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(after.sh, before.sh, atol=1e-5, rtol=1e-5)
    turned = (F.normalize(after.quats, dim=-1) * F.normalize(before.quats, dim=-1)).sum(-1).abs()
    torch.testing.assert_close(turned, torch.ones(40), atol=1e-5, rtol=0)
    torch.testing.assert_close(colors(after), colors(before), atol=2e-3, rtol=0)


def test_layout_of_the_extension(tmp_path: Path) -> None:
    """One Gaussian, quarter turn about its y: y and z change sign in glTF, as do the harmonics of y and z."""
    half = 0.5**0.5
    one = replace(
        scene(1, 1),
        means=torch.tensor([[1.0, 2.0, -3.0]]),
        quats=2 * torch.tensor([[half, 0, half, 0]]),
        scales=torch.tensor([[1.0, 0.5, 0.25]]),
        opacities=torch.tensor([0.4]),
        sh=torch.tensor([[[(0.5 - 0.5) / DC, (1 - 0.5) / DC, -9.0], [0.5, 0, 0], [0, 0.25, 0], [0, 0, -2.0]]]),
    )
    content, binary = chunks(write_gaussian_gltf(tmp_path / "a.glb", one))
    (primitive,) = content["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"] == {NAME: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
    assert content["extensionsUsed"] == [NAME]
    assert "extensionsRequired" not in content  # others show points

    def value(semantic: str) -> list[float]:
        accessor = content["accessors"][primitive["attributes"][semantic]]
        view = content["bufferViews"][accessor["bufferView"]]
        part = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        return np.frombuffer(part, {5126: "<f4", 5121: "u1"}[accessor["componentType"]]).tolist()

    assert value("POSITION") == [1, -2, 3]
    assert content["accessors"][primitive["attributes"]["POSITION"]]["max"] == [1, -2, 3]
    # half a turn about x, then a quarter turn about y: x y z w
    rotation = np.array(value(f"{NAME}:ROTATION"))
    np.testing.assert_allclose(rotation * np.sign(rotation[0]), [half, 0, half, 0], atol=1e-6)
    assert value(f"{NAME}:SCALE") == [1, 0.5, 0.25]
    assert value(f"{NAME}:OPACITY") == pytest.approx([0.4])
    assert value("COLOR_0") == [55, 255, 0, 102]  # linear
    np.testing.assert_allclose(value(f"{NAME}:SH_DEGREE_1_COEF_0"), [-0.5, 0, 0], atol=1e-6)
    np.testing.assert_allclose(value(f"{NAME}:SH_DEGREE_1_COEF_1"), [0, -0.25, 0], atol=1e-6)
    np.testing.assert_allclose(value(f"{NAME}:SH_DEGREE_1_COEF_2"), [0, 0, -2], atol=1e-6)


def test_compressed_files_hold_spz_of_version_2(tmp_path: Path) -> None:
    before = replace(scene(700, 2), sh=torch.tanh(scene(700, 2).sh))
    path = write_gaussian_gltf(tmp_path / "a.glb", before, compressed=True)
    content, binary = chunks(path)
    names = [NAME, f"{NAME}_compression_spz_2"]
    assert content["extensionsUsed"] == content["extensionsRequired"] == names
    extension = content["meshes"][0]["primitives"][0]["extensions"][NAME]
    assert extension["extensions"] == {names[1]: {"bufferView": 0}}
    assert all("bufferView" not in accessor and accessor["count"] == 700 for accessor in content["accessors"])
    inside = gzip.decompress(binary[: content["bufferViews"][0]["byteLength"]])
    assert struct.unpack_from("<4sI", inside) == (b"NGSP", 2)
    after = read_gaussians(path)
    torch.testing.assert_close(after.means, before.means, rtol=0, atol=2e-6)
    turned = (F.normalize(after.quats, dim=-1) * F.normalize(before.quats, dim=-1)).sum(-1).abs()
    assert turned.min() > 0.99  # a byte for each of x y z: w follows from them, coarsely where it is small
    assert turned.mean() > 0.999
    assert (colors(after) - colors(before)).abs().mean() < 0.01
    assert path.stat().st_size < write_gaussian_gltf(tmp_path / "b.glb", before).stat().st_size / 3


def test_what_others_write(tmp_path: Path) -> None:
    """Small integers, interleaved values, two nodes above each other, values in a file of their own."""
    rows = b"".join(
        struct.pack("<3f4b3BxH", *place, *(0, 0, 0, 127), 2, 1, 3, opacity) + struct.pack("<2x3f", 0, 0, 0)
        for place, opacity in (((0, 0, 0), 65535), ((1, 0, 0), 0))
    )
    (tmp_path / "values.bin").write_bytes(rows)
    layout = {
        "POSITION": (0, 5126, "VEC3", False),
        f"{NAME}:ROTATION": (12, 5120, "VEC4", True),
        f"{NAME}:SCALE": (16, 5121, "VEC3", False),
        f"{NAME}:OPACITY": (20, 5123, "SCALAR", True),
        f"{NAME}:SH_DEGREE_0_COEF_0": (24, 5126, "VEC3", False),
    }
    primitive = {
        "mode": 0,
        "attributes": {name: number for number, name in enumerate(layout)},
        "extensions": {NAME: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"translation": [0, 10, 0], "children": [1]},
            {"mesh": 0, "scale": [2, 2, 2], "rotation": [0, 0, 0.5**0.5, 0.5**0.5]},
        ],
        "meshes": [{"primitives": [primitive, {"attributes": {"POSITION": 0}}]}],
        "accessors": [
            {"bufferView": 0, "byteOffset": at, "componentType": kind, "type": shape, "count": 2, "normalized": normal}
            for at, kind, shape, normal in layout.values()
        ],
        "bufferViews": [{"buffer": 0, "byteLength": len(rows), "byteStride": 36}],
        "buffers": [{"uri": "values.bin", "byteLength": len(rows)}],
    }
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(content))
    read = read_gaussian_gltf(path)
    torch.testing.assert_close(read.means, torch.tensor([[0.0, -10, 0], [0, -12, 0]]))
    torch.testing.assert_close(read.scales, torch.tensor([[4.0, 2, 6]] * 2))
    torch.testing.assert_close(read.opacities, torch.tensor([1.0, 0]))

    def refused(said: str, **changes: object) -> None:
        path.write_text(json.dumps(content | changes))
        with pytest.raises(FormatError, match=said):
            read_gaussian_gltf(path)

    refused("differently along its axes", nodes=[{"mesh": 0, "scale": [1, 2, 1]}])
    refused("contain each other", nodes=[{"children": [0]}])
    refused("holds no Gaussians", meshes=[{"primitives": [{"attributes": {"POSITION": 0}}]}], nodes=[{"mesh": 0}])
    refused("not next to it", buffers=[{"uri": "../values.bin", "byteLength": len(rows)}])
    refused("truncated", bufferViews=[{"buffer": 0, "byteLength": 10 * len(rows), "byteStride": 36}])
    refused("damaged", accessors=[])
    embedded = "data:;base64," + base64.b64encode(rows).decode()
    path.write_text(json.dumps(content | {"buffers": [{"uri": embedded, "byteLength": len(rows)}]}))
    assert torch.equal(read_gaussian_gltf(path).means, read.means)


def test_meshes_and_nothing(tmp_path: Path) -> None:
    mesh = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]]), np.zeros((3, 3), np.uint8))
    with pytest.raises(FormatError, match="holds no Gaussians"):
        read_gaussians(write_mesh(tmp_path / "mesh.glb", mesh))
    with pytest.raises(ValueError, match="at least one"):
        write_gaussian_gltf(tmp_path / "a.glb", scene(0))
