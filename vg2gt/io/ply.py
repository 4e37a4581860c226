"""PLY files of Gaussians in the layout of 3D Gaussian Splatting.

A file has one ``vertex`` element of floats, in this order: ``x y z``, ``nx ny nz`` (zeros), ``f_dc_0..2``, ``f_rest_*``
(none or 45, all of red before green before blue), ``opacity`` (logit), ``scale_0..2`` (logarithms), ``rot_0..3``
(wxyz). Our scenes add ``error`` and ``support`` (:mod:`vg2gt.uncertainty`). The background colour is in a comment,
``background R G B`` in [0, 1], which other programs ignore.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from vg2gt.io.errors import FormatError
from vg2gt.io.files import regular, write_bytes
from vg2gt.io.gaussian_arrays import OPACITY_MARGIN, GaussianArrays, to_arrays, to_gaussians
from vg2gt.types import Gaussians

_FLATNESS = 0.01  # thickness of 2DGS Gaussians, which have none, relative to their smaller side
_FULL_REST = 45  # spherical harmonics up to degree 3 without the constant ones
_POSITION = ("x", "y", "z")
_DC = tuple(f"f_dc_{i}" for i in range(3))
_SCALE = tuple(f"scale_{i}" for i in range(3))
_ROTATION = tuple(f"rot_{i}" for i in range(4))
_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ENCODINGS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_HEADER_LIMIT = 1 << 16
_END = b"end_header"


def write_gaussian_ply(path: str | Path, gaussians: Gaussians, *, extra: Mapping[str, NDArray] | None = None) -> Path:
    """Writes one scene's Gaussians as a 3DGS file (binary, little endian), atomically.

    Args:
        path: the file.
        gaussians: one scene; not changed. Opacities are kept 6e-8 away from 0 and 1, whose logits are infinite. Degrees
            1 and 2 are padded with zeros to the 45 ``f_rest`` that other programs expect.
        extra: further properties ``[G]`` by name, written as floats after all others; viewers ignore them.

    Raises:
        ValueError: if there is more than one scene or a value cannot be written.
    """
    arrays, extra = to_arrays(gaussians), extra or {}
    count, coefficients = arrays.sh.shape[:2]
    rest = np.zeros((count, 3, _FULL_REST // 3 if coefficients > 1 else 0))
    rest[:, :, : coefficients - 1] = arrays.sh[:, 1:].transpose(0, 2, 1)
    rest = rest.reshape(count, rest.shape[1] * rest.shape[2])
    opacities = arrays.opacities.clip(OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    logits = np.log(opacities) - np.log1p(-opacities)
    more = [f"f_rest_{i}" for i in range(rest.shape[1])]
    names = (*_POSITION, "nx", "ny", "nz", *_DC, *more, "opacity", *_SCALE, *_ROTATION, *extra)
    columns = (
        arrays.means,
        np.zeros((count, 3)),
        arrays.sh[:, 0],
        rest,
        logits[:, None],
        np.log(arrays.scales),
        arrays.quats,
        *(values[:, None] for values in extra.values()),
    )
    comments = []
    if gaussians.background is not None:
        comments = ["comment background " + " ".join(f"{value:.6g}" for value in gaussians.background[0].tolist())]
    lines = ["ply", "format binary_little_endian 1.0", *comments, f"element vertex {count}"]
    head = "\n".join([*lines, *(f"property float {name}" for name in names), "end_header", ""]).encode()
    return write_bytes(path, head + np.concatenate(columns, 1).astype("<f4").tobytes())


def read_gaussian_ply(path: str | Path) -> Gaussians:
    """Reads a binary 3DGS file.

    Normals may be missing, there may be 0, 9, 24 or 45 ``f_rest``, and other properties are ignored. Without
    ``scale_2`` (2DGS), Gaussians are flat. Rows with values that are not finite or a zero quaternion are dropped with a
    warning.

    Returns:
        The Gaussians as scene 0, float32, with activations applied: standard deviations and opacities. Quaternions are
        not normalised.

    Raises:
        FormatError: if the file is damaged or holds something else.
    """
    path = Path(path)
    table, comments = _read_vertices(path)
    found = table.dtype.names or ()
    rest = tuple(f"f_rest_{i}" for i in range(sum(name.startswith("f_rest_") for name in found)))
    if len(rest) not in (0, 9, 24, 45):
        raise FormatError(f"{path}: {len(rest)} f_rest properties, expected 0, 9, 24 or 45 (degree 0 to 3)")
    higher = _columns(path, table, rest).reshape(len(table), 3, len(rest) // 3).transpose(0, 2, 1)
    sh = np.concatenate((_columns(path, table, _DC)[:, None], higher), 1)
    with np.errstate(over="ignore"):  # infinite results are counted and dropped later
        opacities = 1 / (1 + np.exp(-_columns(path, table, ("opacity",))[:, 0]))
        sides = _SCALE if _SCALE[2] in found or _SCALE[0] not in found else _SCALE[:2]
        scales = np.exp(_columns(path, table, sides))
        if len(sides) == 2:
            scales = np.concatenate((scales, _FLATNESS * scales.min(1, keepdims=True)), 1)
    means, quats = _columns(path, table, _POSITION), _columns(path, table, _ROTATION)
    gaussians = to_gaussians(path, GaussianArrays(means, quats, scales, opacities, sh))
    return replace(gaussians, background=_background(comments))


def read_properties(path: str | Path, *names: str) -> dict[str, NDArray[np.float64]]:
    """Reads vertex properties ``[N]``, such as ``error`` and ``support`` of our scenes; missing ones are left out.

    Raises:
        FormatError: if the file is damaged.
    """
    table, _ = _read_vertices(Path(path))
    return {name: table[name].astype(np.float64) for name in names if name in (table.dtype.names or ())}


def _background(comments: Sequence[str]) -> torch.Tensor | None:
    """Background colour ``[1, 3]`` from the comments; None if missing or invalid."""
    for comment in comments:
        word, _, values = comment.partition(" ")
        try:
            color = torch.tensor([float(value) for value in values.split()])
        except ValueError:
            continue
        if word == "background" and len(color) == 3 and bool(((color >= 0) & (color <= 1)).all()):
            return color[None]
    return None


def _columns(path: Path, table: NDArray, names: tuple[str, ...]) -> NDArray[np.float64]:
    """Stacks properties to ``[N, len(names)]``, float64."""
    missing = [name for name in names if name not in (table.dtype.names or ())]
    if missing:
        what = f"vertices have no {', '.join(missing)}, only {', '.join(table.dtype.names or ())}"
        raise FormatError(f"{path}: {what} (a compressed PLY is converted by PlayCanvas's splat-transform)")
    values = np.empty((len(table), len(names)))
    with np.errstate(invalid="ignore"):  # signalling NaNs of damaged files become quiet NaNs
        for i, name in enumerate(names):
            values[:, i] = table[name]
    return values


def _read_vertices(path: Path) -> tuple[NDArray, list[str]]:
    """Reads the ``vertex`` element as a structured array, and the header's comments."""
    data = regular(path).read_bytes()
    end = data.find(_END, 0, _HEADER_LIMIT)
    offset = data.find(b"\n", end, end + len(_END) + 3) + 1
    if not data.startswith(b"ply") or end < 0 or offset == 0:
        raise FormatError(f"{path}: not a PLY file, expected a header from 'ply' to 'end_header'")
    lines = data[:end].decode("latin-1").splitlines()
    comments = [line.removeprefix("comment").strip() for line in lines if line.startswith("comment ")]
    dtype, count = _layout(path, [line.split() for line in lines])
    needed, left = count * dtype.itemsize, len(data) - offset
    if needed > left:
        raise FormatError(f"{path}: {count} vertices need {needed} bytes, {left} are left; it is truncated or damaged")
    return np.frombuffer(data, dtype, count, offset), comments


def _layout(path: Path, lines: list[list[str]]) -> tuple[np.dtype, int]:
    """Type of a vertex and number of vertices, which must come first; later elements are ignored."""
    order, count = "", -1
    types: dict[str, str] = {}
    for number, words in enumerate(lines, 1):
        match words:
            case [] | ["ply" | "comment" | "obj_info", *_]:
                continue
            case ["format", encoding, _] if encoding in _ENCODINGS:
                order = _ENCODINGS[encoding]
            case ["element", "vertex", text] if order and text.isascii() and text.isdigit() and len(text) <= 18:
                count = int(text)
            case ["element", *_] if types:
                break
            case ["element", "chunk", *_]:
                raise FormatError(f"{path}: a compressed PLY; splat-transform converts it to an ordinary one")
            case ["property", kind, name] if count >= 0 and kind in _TYPES and name not in types:
                types[name] = order + _TYPES[kind]
            case _:
                what = f"line {number} of the header: unexpected {' '.join(words)[:60]!r}"
                raise FormatError(f"{path}, {what}; it is damaged, or does not begin with binary vertices")
    if not types:
        raise FormatError(f"{path}: no vertices in the header; this is not a file of points")
    return np.dtype(list(types.items())), count
