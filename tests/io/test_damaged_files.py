"""Every reader refuses a damaged file with its documented error, or reads it."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.io.gaussian_scenes import scene
from tests.io.mutations import survives
from tests.io.test_cameras_json import mixed
from tests.io.test_colmap import small_model
from tests.io.test_nerfstudio import random_transforms
from tests.io.test_ply import header
from vg2gt import io
from vg2gt.io.colmap import FILES


def ascii_points(path: Path) -> None:
    head = header(20, ["x", "y", "z"]).replace(b"binary_little_endian", b"ascii")
    path.write_bytes(head + b"1.5 -2e3 7\n" * 20)
    assert len(io.read_point_ply(path).positions) == 20


CASES: dict[str, tuple[Callable[[Path], object], Callable[[Path], object]]] = {
    "scene.ply": (lambda path: io.write_gaussian_ply(path, scene(12, 1)), io.read_gaussian_ply),
    "points.ply": (
        lambda path: io.write_point_ply(path, np.ones((20, 3)), np.zeros((20, 3), np.uint8)),
        io.read_point_ply,
    ),
    "ascii.ply": (ascii_points, io.read_point_ply),
    "scene.splat": (lambda path: io.write_splat(path, scene(12)), io.read_splat),
    "scene.spz": (lambda path: io.write_spz(path, scene(12, 1)), io.read_spz),
    "scene.glb": (lambda path: io.write_gaussian_glb(path, scene(12, 1)), io.read_gaussian_glb),
    "scene.compressed.ply": (lambda path: io.write_compressed_ply(path, scene(12, 1)), io.read_gaussian_ply),
    "transforms.json": (lambda path: io.write_transforms(path, random_transforms(False, 3)), io.read_transforms),
    "cameras.json": (lambda path: io.write_cameras_json(path, mixed()), io.read_cameras_json),
    **{
        f"{name}{suffix}": (
            lambda path: io.write_colmap(path.parent, small_model(points=20), text=path.suffix == ".txt"),
            lambda path: io.read_colmap(path.parent),
        )
        for name in FILES
        for suffix in (".bin", ".txt")
    },
}


@pytest.mark.parametrize("count", [60, pytest.param(600, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", CASES)
def test_damaged_files_are_refused_or_read(tmp_path: Path, name: str, count: int) -> None:
    write, read = CASES[name]
    path = tmp_path / name
    write(path)
    refused, whole = survives(lambda: read(path), path, count)
    assert refused > count / 4
    assert whole > 0 or not name.endswith(".splat")
