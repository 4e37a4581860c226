"""PLY files: Gaussians in the layout of 3D Gaussian Splatting, and coloured points.

A Gaussian file has one ``vertex`` element of floats, in this order: ``x y z``, ``nx ny nz`` (zeros), ``f_dc_0..2``,
``f_rest_*`` (none or 45, all of red before green before blue), ``opacity`` (logit), ``scale_0..2`` (logarithms),
``rot_0..3`` (wxyz). Our scenes add ``error`` and ``support`` (:mod:`vg2gt.uncertainty`). The background colour is in a
comment, ``background R G B`` in [0, 1], which other programs ignore.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from vg2gt.io.compressed_ply import unpacked
from vg2gt.io.errors import FormatError
from vg2gt.io.files import write_bytes
from vg2gt.io.gaussian_arrays import OPACITY_MARGIN, GaussianArrays, to_arrays, to_gaussians
from vg2gt.io.ply_container import ply_content, read_comments, read_elements, read_vertices
from vg2gt.types import Gaussians

POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
COLOR = ("red", "green", "blue")
FLATNESS = 0.01  # thickness of 2DGS Gaussians, which have none, relative to their smaller side
FULL_REST = 45  # spherical harmonics up to degree 3 without the constant ones
_DC = tuple(f"f_dc_{i}" for i in range(3))
_SCALE = tuple(f"scale_{i}" for i in range(3))
_ROTATION = tuple(f"rot_{i}" for i in range(4))


@dataclass(frozen=True, eq=False)
class ColoredPoints:
    """Points of one scene.

    Attributes:
        positions: ``[N, 3]`` float32 or float64, world frame.
        colors: ``[N, 3]`` uint8, or None.
    """

    positions: NDArray[np.floating]
    colors: NDArray[np.uint8] | None = None


def write_gaussian_ply(
    path: str | Path, gaussians: Gaussians, *, full_sh: bool = False, extra: Mapping[str, NDArray] | None = None
) -> Path:
    """Writes one scene's Gaussians as a 3DGS file (binary, little endian), atomically.

    Args:
        path: the file.
        gaussians: one scene; not changed. Opacities are kept 6e-8 away from 0 and 1, whose logits are infinite.
        full_sh: write 45 ``f_rest`` even for view-independent colours, as the original 3DGS viewer requires. Degrees 1
            and 2 are always padded with zeros to 45.
        extra: further properties ``[G]`` by name, written as floats after all others; viewers ignore them.

    Raises:
        ValueError: if there is more than one scene or a value cannot be written.
    """
    arrays = to_arrays(gaussians)
    count, coefficients = arrays.sh.shape[:2]
    rest = np.zeros((count, 3, FULL_REST // 3 if coefficients > 1 or full_sh else 0))
    rest[:, :, : coefficients - 1] = arrays.sh[:, 1:].transpose(0, 2, 1)
    rest = rest.reshape(count, rest.shape[1] * rest.shape[2])
    opacities = arrays.opacities.clip(OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    logits = np.log(opacities) - np.log1p(-opacities)
    names = (*POSITION, *NORMAL, *_DC, *(f"f_rest_{i}" for i in range(rest.shape[1])), "opacity", *_SCALE, *_ROTATION)
    extra = extra or {}
    names = (*names, *extra)
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
    table = np.concatenate(columns, 1).astype("<f4").view([(name, "<f4") for name in names])[:, 0]
    comments = []
    if gaussians.background is not None:
        comments = ["background " + " ".join(f"{value:.6g}" for value in gaussians.background[0].tolist())]
    return write_bytes(path, ply_content({"vertex": table}, comments))


def read_gaussian_ply(path: str | Path) -> Gaussians:
    """Reads a 3DGS file, or SuperSplat's compressed PLY (:mod:`vg2gt.io.compressed_ply`).

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
    elements = read_elements(path, "vertex", "chunk", "sh")
    table = elements["vertex"]
    found = table.dtype.names or ()
    if "packed_position" in found:
        return to_gaussians(path, unpacked(path, elements))
    rest = [name for name in found if name.startswith("f_rest_")]
    if len(rest) not in (0, 9, 24, 45):
        raise FormatError(
            f"{path}: {len(rest)} f_rest properties, expected 0, 9, 24 or 45 (degree 0 to 3); write the file again"
        )
    sh = np.concatenate(
        (
            _columns(path, table, _DC)[:, None],
            _columns(path, table, tuple(f"f_rest_{i}" for i in range(len(rest))))
            .reshape(len(table), 3, len(rest) // 3)
            .transpose(0, 2, 1),
        ),
        1,
    )
    with np.errstate(over="ignore"):  # infinite results are counted and dropped later
        opacities = 1 / (1 + np.exp(-_columns(path, table, ("opacity",))[:, 0]))
        sides = _SCALE if _SCALE[2] in found or _SCALE[0] not in found else _SCALE[:2]
        scales = np.exp(_columns(path, table, sides))
        if len(sides) == 2:
            scales = np.concatenate((scales, FLATNESS * scales.min(1, keepdims=True)), 1)
    means, quats = _columns(path, table, POSITION), _columns(path, table, _ROTATION)
    gaussians = to_gaussians(path, GaussianArrays(means, quats, scales, opacities, sh))
    return replace(gaussians, background=_background(path))


def read_properties(path: str | Path, *names: str) -> dict[str, NDArray[np.float64]]:
    """Reads vertex properties ``[N]``, such as ``error`` and ``support`` of our scenes; missing ones are left out.

    Raises:
        FormatError: if the file is damaged.
    """
    table = read_vertices(Path(path))
    return {name: table[name].astype(np.float64) for name in names if name in (table.dtype.names or ())}


def write_point_ply(path: str | Path, positions: ArrayLike, colors: ArrayLike | None = None) -> Path:
    """Writes points as float32 ``x y z`` and, if given, uchar ``red green blue``, atomically.

    Args:
        path: the file.
        positions: ``[N, 3]``.
        colors: ``[N, 3]`` uint8, or None.

    Raises:
        ValueError: if shapes or types are wrong.
    """
    xyz = np.asarray(positions, np.float64)
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise ValueError(f"positions must be [N, 3], got {list(xyz.shape)}")
    names = [(name, "<f4") for name in POSITION]
    columns = list(xyz.T)
    if colors is not None:
        rgb = np.asarray(colors)
        if rgb.shape != xyz.shape or rgb.dtype != np.uint8:
            raise ValueError(
                f"colors must be uint8 {list(xyz.shape)} like positions, got {rgb.dtype} {list(rgb.shape)}"
            )
        names += [(name, "u1") for name in COLOR]
        columns += list(rgb.T)
    table = np.empty(len(xyz), names)
    for (name, _), column in zip(names, columns, strict=True):
        table[name] = column
    return write_bytes(path, ply_content({"vertex": table}))


def read_point_ply(path: str | Path) -> ColoredPoints:
    """Reads the vertices of a PLY file as points; faces and other properties are ignored.

    Args:
        path: the file, binary or ASCII.

    Returns:
        Positions (float64 if the file has doubles), and colours if it has uchar ``red green blue``.

    Raises:
        FormatError: if the file is damaged or has no ``x y z``.
    """
    path = Path(path)
    table = read_vertices(path)
    wide = any(table.dtype[name] == np.float64 for name in POSITION if name in (table.dtype.names or ()))
    positions = _columns(path, table, POSITION).astype(np.float64 if wide else np.float32)
    colored = all(name in (table.dtype.names or ()) and table.dtype[name] == np.uint8 for name in COLOR)
    return ColoredPoints(positions, np.stack([table[name] for name in COLOR], -1) if colored else None)


def _background(path: Path) -> torch.Tensor | None:
    """Background colour ``[1, 3]`` from the comments; None if missing or invalid."""
    for comment in read_comments(path):
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
        raise FormatError(
            f"{path}: vertices have no {', '.join(missing)}, only {', '.join(table.dtype.names or ())}; "
            "expected x y z for points and x y z f_dc_* opacity scale_* rot_* for Gaussians (not a compressed PLY)"
        )
    values = np.empty((len(table), len(names)))
    with np.errstate(invalid="ignore"):  # signalling NaNs of damaged files become quiet NaNs
        for i, name in enumerate(names):
            values[:, i] = table[name]
    return values
