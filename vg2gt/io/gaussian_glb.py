"""GLB with Gaussians: glTF's extension ``KHR_gaussian_splatting``, kernel ``ellipse``, all values float32.

Programs without the extension show coloured points. glTF has y up and z backward; positions, rotations and spherical
harmonics are converted from and to our axes. Specification:
https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vg2gt.geometry.spherical_harmonics import DC
from vg2gt.io.errors import FormatError
from vg2gt.io.files import regular, write_bytes
from vg2gt.io.gaussian_arrays import GaussianArrays, to_arrays, to_gaussians, upright
from vg2gt.types import Gaussians

EXTENSION = "KHR_gaussian_splatting"
_KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}  # glTF's component types
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_COEFFICIENTS = [f"SH_DEGREE_{degree}_COEF_{i}" for degree in range(4) for i in range(2 * degree + 1)]
_JSON, _BIN = 0x4E4F534A, 0x004E4942


def write_gaussian_glb(path: str | Path, gaussians: Gaussians) -> Path:
    """Writes one scene's Gaussians in order, as float32, atomically.

    Args:
        path: the file.
        gaussians: one scene, not empty; not changed. Quaternions are normalised.

    Raises:
        ValueError: if there are no Gaussians, more than one scene, or values that cannot be written.
    """
    arrays = upright(to_arrays(gaussians))
    length = np.linalg.norm(arrays.quats, axis=1, keepdims=True)
    if not len(length) or (length == 0).any():
        raise ValueError("a .glb needs at least one Gaussian" if not len(length) else "quats must have nonzero norm")
    shown = (arrays.sh[:, 0] * DC + 0.5).clip(0, 1)
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)  # COLOR_0 is linear
    own = {
        "ROTATION": np.roll(arrays.quats / length, -1, 1),
        "SCALE": arrays.scales,
        "OPACITY": arrays.opacities[:, None],
        **{name: arrays.sh[:, i] for i, name in enumerate(_COEFFICIENTS[: arrays.sh.shape[1]])},
    }
    columns = {"POSITION": arrays.means, "COLOR_0": np.concatenate((linear, arrays.opacities[:, None]), 1)}
    columns |= {f"{EXTENSION}:{name}": values for name, values in own.items()}
    parts = [values.astype("<f4") for values in columns.values()]
    ends = np.cumsum([0, *(part.nbytes for part in parts)]).tolist()
    accessors = [_accessor(i, part) for i, part in enumerate(parts)]
    accessors[0] |= {"min": parts[0].min(0).tolist(), "max": parts[0].max(0).tolist()}
    primitive = {
        "mode": 0,
        "attributes": {name: i for i, name in enumerate(columns)},
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    gltf = {
        "asset": {"version": "2.0", "generator": "vg2gt"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "gaussians"}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": part.nbytes, "target": 34962}
            for start, part in zip(ends, parts, strict=False)
        ],
        "buffers": [{"byteLength": ends[-1]}],
    }
    text = json.dumps(gltf, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + ends[-1], len(text), _JSON)
    body = b"".join(part.tobytes() for part in parts)
    return write_bytes(path, head + text + struct.pack("<II", ends[-1], _BIN) + body)


def _accessor(view: int, part: NDArray) -> dict[str, Any]:
    kind = {width: name for name, width in _WIDTHS.items()}[part.shape[1]]
    return {"bufferView": view, "componentType": 5126, "count": len(part), "type": kind}


def read_gaussian_glb(path: str | Path) -> Gaussians:
    """Reads the first primitive with Gaussians; its node must have no transformation.

    Args:
        path: the file, with one binary chunk.

    Returns:
        The Gaussians as scene 0, float32.

    Raises:
        FormatError: if the file is damaged, holds no Gaussians, or a node transforms them.
    """
    path = Path(path)
    content = regular(path).read_bytes()
    try:
        size = struct.unpack_from("<4sIIII", content)[3]
        gltf = json.loads(content[20 : 20 + size])
        body = memoryview(content)[28 + size :]
        mesh, primitive = next(
            (i, primitive)
            for i, mesh in enumerate(gltf["meshes"])
            for primitive in mesh["primitives"]
            if EXTENSION in primitive.get("extensions", {})
        )
        moved = [node for node in gltf["nodes"] if {"matrix", "translation", "rotation", "scale"} & node.keys()]
        if any(mesh == node.get("mesh") or node.get("children") for node in moved):
            raise FormatError(f"{path}: a node moves the Gaussians; write the file with the transformation applied")
        found = {name.removeprefix(f"{EXTENSION}:"): i for name, i in primitive["attributes"].items()}
        columns = {name: _column(gltf, body, i) for name, i in found.items() if name != "COLOR_0"}
        arrays = GaussianArrays(
            columns["POSITION"],
            np.roll(columns["ROTATION"], 1, 1),
            columns["SCALE"],
            columns["OPACITY"][:, 0],
            np.stack([columns[name] for name in _COEFFICIENTS if name in columns], 1),
        )
    except StopIteration:
        raise FormatError(f"{path}: no Gaussians ({EXTENSION}); points and meshes cannot be rendered here") from None
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, struct.error) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"{path}: not a GLB of Gaussians, or damaged: {type(error).__name__} {error}") from error
    lengths = {len(values) for values in columns.values()}
    if len(lengths) > 1 or arrays.sh.shape[1] not in (1, 4, 9, 16) or (arrays.scales < 0).any():
        raise FormatError(
            f"{path}: attributes of {sorted(lengths)} Gaussians, {arrays.sh.shape[1]} coefficients; damaged"
        )
    return to_gaussians(path, upright(arrays))


def _column(gltf: dict[str, Any], body: memoryview, index: int) -> NDArray[np.float64]:
    accessor = gltf["accessors"][index]
    view = gltf["bufferViews"][accessor["bufferView"]]
    kind, width = np.dtype(_KINDS[accessor["componentType"]]), _WIDTHS[accessor["type"]]
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    step = view.get("byteStride", kind.itemsize * width)
    with np.errstate(invalid="ignore"):  # signalling NaNs of damaged files become quiet NaNs
        values = np.ndarray((accessor["count"], width), kind, body, start, (step, kind.itemsize)).astype(np.float64)
    return values / np.iinfo(kind).max if accessor.get("normalized") else values
