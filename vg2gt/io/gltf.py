"""Gaussians in glTF: ``.glb`` and ``.gltf`` with Khronos' ``KHR_gaussian_splatting``, after its release candidate.

A point primitive with linear scales, rotations xyzw, opacities in [0, 1] and a VEC3 for each spherical harmonic, and
colours as points for viewers that do not know the extension. Compressed files hold an SPZ of version 2 instead, as the
draft ``KHR_gaussian_splatting_compression_spz_2`` asks for, with the positions of glTF, as Cesium reads them. glTF has
y up, our world has y down: scenes are turned by 180 degrees about x, and back when they are read.

Format: https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting
"""

from __future__ import annotations

import base64
import binascii
import json
import logging
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from vg2gt.geometry.alignment import Similarity
from vg2gt.geometry.spherical_harmonics import DC
from vg2gt.io.errors import FormatError
from vg2gt.io.files import regular, write_bytes
from vg2gt.io.gaussian_arrays import GaussianArrays, to_arrays, to_gaussians
from vg2gt.io.mesh import linear_colors
from vg2gt.io.spz import decode_spz, encode_spz
from vg2gt.types import Gaussians

log = logging.getLogger(__name__)

_NAME = "KHR_gaussian_splatting"
_SPZ = f"{_NAME}_compression_spz"
_MAGIC, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_SIDES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_EMBEDDED = "data:application/octet-stream;base64,"
_OUR_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
_SAME = 1e-4  # relative difference of the lengths of a node's axes


def write_gaussian_gltf(
    path: str | Path, gaussians: Gaussians, compressed: bool = False, antialiased: bool = False
) -> Path:
    """Writes one scene's Gaussians in order, atomically, in one file.

    Args:
        path: a file ending in ``.glb`` (binary) or ``.gltf`` (JSON that contains the values).
        gaussians: the scene.
        compressed: write an SPZ of version 2 inside, about a quarter of the size; :mod:`vg2gt.io.spz` lists losses.
        antialiased: as for :func:`vg2gt.io.write_spz`; only compressed files can say so.

    Raises:
        ValueError: if there is not exactly one scene, it is empty, or a value cannot be written.
    """
    path = Path(path)
    arrays = to_arrays(_turned(gaussians, _OUR_AXES))
    if not len(arrays.means):
        raise ValueError(f"{path}: a glTF file holds at least one Gaussian, the scene has none")
    columns = _columns(arrays)
    used = [_NAME, *[f"{_SPZ}_2"] * compressed]
    extension: dict[str, Any] = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    accessors = [_accessor(values, None if compressed else view) for view, values in enumerate(columns.values())]
    accessors[0] |= {"min": columns["POSITION"].min(0).tolist(), "max": columns["POSITION"].max(0).tolist()}
    parts = [values.tobytes() for values in columns.values()]
    if compressed:
        parts = [encode_spz(arrays, version=2, antialiased=antialiased)]
        extension["extensions"] = {used[1]: {"bufferView": 0}}
    starts = np.cumsum([0, *(len(part) for part in parts)]).tolist()
    target = {} if compressed else {"target": 34962}
    content: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "vg2gt"},
        "extensionsUsed": used,
        **({"extensionsRequired": used} if compressed else {}),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {
                "primitives": [
                    {
                        "mode": 0,
                        "attributes": {name: index for index, name in enumerate(columns)},
                        "extensions": {_NAME: extension},
                    }
                ]
            }
        ],
        "accessors": accessors,
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": len(part), **target}
            for start, part in zip(starts, parts, strict=False)
        ],
        "buffers": [{"byteLength": starts[-1]}],
    }
    binary = b"".join(parts)
    if path.suffix.lower() == ".gltf":
        content["buffers"][0]["uri"] = _EMBEDDED + base64.b64encode(binary).decode()
        return write_bytes(path, json.dumps(content).encode())
    head = json.dumps(content).encode()
    head, binary = head + b" " * (-len(head) % 4), binary + b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<II", len(head), _JSON) + head + struct.pack("<II", len(binary), _BINARY) + binary
    return write_bytes(path, struct.pack("<III", _MAGIC, 2, 12 + len(chunks)) + chunks)


def read_gaussian_gltf(path: str | Path) -> Gaussians:
    """Reads all Gaussians of a ``.glb`` or ``.gltf`` file, placed by its nodes; meshes and points are left out.

    Returns:
        The Gaussians as scene 0, float32, in our world frame.

    Raises:
        FormatError: if the file is damaged, holds no Gaussians, or scales them differently along its axes.
    """
    path = Path(path)
    try:
        content, buffers = _parsed(path)
        found = [
            _turned(to_gaussians(path, _arrays(path, content, buffers, primitive)), _OUR_AXES @ matrix)
            for node, matrix in _nodes(content)
            for primitive in content["meshes"][node["mesh"]]["primitives"]
            if _NAME in primitive.get("extensions", {})
        ]
    except FormatError as error:
        raise error if str(path) in str(error) else FormatError(f"{path}: {error}") from error
    except (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError, struct.error) as error:
        raise FormatError(f"{path}: not a glTF file, or damaged ({type(error).__name__}: {error})") from error
    if not found:
        raise FormatError(f"{path} holds no Gaussians ({_NAME}); a mesh or points are not shown")
    joined, *others = sorted(found, key=lambda part: -part.sh.shape[1])
    for other in others:
        joined = joined.joined(other)
    return joined


def _columns(arrays: GaussianArrays) -> dict[str, NDArray[np.generic]]:
    """Returns the attributes of the primitive; without a viewer for Gaussians, its points have linear colours."""
    quats = np.roll(arrays.quats, -1, 1) / np.linalg.norm(arrays.quats, axis=1, keepdims=True)
    plain = ((arrays.sh[:, 0] * DC + 0.5).clip(0, 1) * 255 + 0.5).astype("u1")
    alpha = (arrays.opacities[:, None] * 255 + 0.5).astype("u1")
    columns: dict[str, NDArray[np.generic]] = {
        "POSITION": arrays.means.astype("<f4"),
        "COLOR_0": np.concatenate((linear_colors(plain), alpha), 1),
        f"{_NAME}:ROTATION": quats.astype("<f4"),
        f"{_NAME}:SCALE": arrays.scales.astype("<f4"),
        f"{_NAME}:OPACITY": arrays.opacities.astype("<f4"),
    }
    for number in range(arrays.sh.shape[1]):
        columns[_harmonic(number)] = arrays.sh[:, number].astype("<f4")
    return columns


def _harmonic(number: int) -> str:
    degree = int(number**0.5)
    return f"{_NAME}:SH_DEGREE_{degree}_COEF_{number - degree**2}"


def _accessor(values: NDArray[np.generic], view: int | None) -> dict[str, Any]:
    shape = "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}"
    is_color = values.dtype == np.uint8
    kind = {"componentType": 5121, "normalized": True} if is_color else {"componentType": 5126}
    return {**({} if view is None else {"bufferView": view}), **kind, "count": len(values), "type": shape}


def _turned(gaussians: Gaussians, matrix: NDArray[np.float64]) -> Gaussians:
    """Moves Gaussians by a matrix ``[4, 4]``; raises FormatError if it is no similarity."""
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    scale = float(lengths.mean())
    turn = matrix[:3, :3] / scale
    if not np.abs(turn.T @ turn - np.eye(3)).max() < _SAME or np.linalg.det(turn) < 0:
        raise FormatError("a node scales Gaussians differently along its axes, or mirrors them: apply its transform")
    length, shift = torch.tensor([scale], dtype=torch.float64), torch.from_numpy(matrix[None, :3, 3].copy())
    return Similarity(length, torch.from_numpy(turn[None]), shift).apply_gaussians(gaussians)


def _parsed(path: Path) -> tuple[dict[str, Any], list[bytes]]:
    """Returns the JSON of a file, and its buffers."""
    data, embedded = regular(path).read_bytes(), None
    if data[:4] == struct.pack("<I", _MAGIC):
        start = 12
        chunks: dict[int, bytes] = {}
        while start + 8 <= len(data):
            length, kind = struct.unpack_from("<II", data, start)
            chunks.setdefault(kind, data[start + 8 : start + 8 + length])
            start += 8 + length
        data, embedded = chunks[_JSON], chunks.get(_BINARY, b"")
    content = json.loads(data)
    return content, [_buffer(path, buffer, embedded) for buffer in content.get("buffers", [])]


def _buffer(path: Path, buffer: dict[str, Any], embedded: bytes | None) -> bytes:
    uri = buffer.get("uri")
    if uri is None:
        if embedded is None:
            raise FormatError(f"{path}: a buffer has neither an address nor values")
        return embedded
    if uri.startswith("data:"):
        try:
            return base64.b64decode(uri.partition(",")[2], validate=True)
        except binascii.Error as error:
            raise FormatError(f"{path}: the values inside are damaged ({error})") from error
    file = path.parent / uri
    if Path(uri).name != uri or not file.is_file():  # a file must not make us read others of this machine
        raise FormatError(f"{path}: its values are in {uri}, which is not next to it")
    return regular(file).read_bytes()


def _nodes(content: dict[str, Any]) -> Iterator[tuple[dict[str, Any], NDArray[np.float64]]]:
    """Yields the nodes with a mesh, and their transformations ``[4, 4]`` to the file's world."""
    nodes = content.get("nodes", [])
    scenes = content.get("scenes")
    roots = scenes[content.get("scene", 0)].get("nodes", []) if scenes else range(len(nodes))
    waiting = [(index, np.eye(4), 0) for index in roots]
    while waiting:
        index, above, depth = waiting.pop()
        node = nodes[index]
        matrix = above @ _matrix(node)
        if "mesh" in node:
            yield node, matrix
        if depth > len(nodes):
            raise FormatError("the nodes of the file contain each other")
        waiting += [(child, matrix, depth + 1) for child in node.get("children", [])]


def _matrix(node: dict[str, Any]) -> NDArray[np.float64]:
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    matrix = np.eye(4)
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), float)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = np.eye(3) + 2 * w * cross + 2 * cross @ cross
    matrix[:3, :3] = turn * np.array(node.get("scale", (1, 1, 1)), float)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _arrays(path: Path, content: dict[str, Any], buffers: list[bytes], primitive: dict[str, Any]) -> GaussianArrays:
    """Returns the Gaussians of a primitive in the axes of its node."""
    extension = primitive["extensions"][_NAME]
    if extension.get("colorSpace", "").startswith("lin_"):
        log.warning("%s has linear colours, which are shown as they are, too dark", path)
    for name, inside in extension.get("extensions", {}).items():
        if name.startswith(_SPZ):
            return decode_spz(path, _view(content, buffers, inside["bufferView"]))
        raise FormatError(f"{path}: its Gaussians are compressed by {name}, which is not known: convert them to PLY")
    attributes = primitive["attributes"]

    def column(name: str) -> NDArray[np.float64]:
        if name not in attributes:
            raise FormatError(f"{path}: Gaussians without {name}")
        return _values(path, content, buffers, content["accessors"][attributes[name]])

    count = next(number for number in (16, 9, 4, 1) if number == 1 or _harmonic(number - 1) in attributes)
    return GaussianArrays(
        column("POSITION"),
        np.roll(column(f"{_NAME}:ROTATION"), 1, 1),
        column(f"{_NAME}:SCALE"),
        column(f"{_NAME}:OPACITY")[:, 0],
        np.stack([column(_harmonic(number)) for number in range(count)], 1),
    )


def _values(path: Path, content: dict[str, Any], buffers: list[bytes], accessor: dict[str, Any]) -> NDArray[np.float64]:
    """Returns the values ``[N, side]`` of an accessor; normalised integers become [0, 1] or [-1, 1]."""
    if "sparse" in accessor or "bufferView" not in accessor:
        raise FormatError(f"{path}: values that are sparse, or compressed in an unknown way; convert it to PLY")
    view, kind = content["bufferViews"][accessor["bufferView"]], np.dtype(_TYPES[accessor["componentType"]])
    side = _SIDES[accessor["type"]]
    step = view.get("byteStride", side * kind.itemsize)
    raw = np.ndarray(
        (accessor["count"], side),
        kind,
        _view(content, buffers, accessor["bufferView"]),
        accessor.get("byteOffset", 0),
        (step, kind.itemsize),
    )
    values = raw.astype(np.float64)
    return (values / np.iinfo(kind).max).clip(-1, 1) if accessor.get("normalized") else values


def _view(content: dict[str, Any], buffers: list[bytes], number: int) -> bytes:
    view = content["bufferViews"][number]
    start = view.get("byteOffset", 0)
    part = buffers[view["buffer"]][start : start + view["byteLength"]]
    if len(part) < view["byteLength"]:
        raise FormatError("the file is shorter than it says; it is truncated")
    return part
