"""Every reader refuses a damaged file with its documented error, or reads it."""

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.io.gaussian_scenes import scene
from tests.io.mutations import mutations
from tests.io.test_cameras_json import mixed
from tests.io.test_colmap import small_model, write
from tests.io.test_nerfstudio import random_transforms
from vg2gt import io
from vg2gt.io.colmap import FILES

CASES: dict[str, tuple[Callable[[Path], object], Callable[[Path], object]]] = {
    "scene.ply": (lambda path: io.write_gaussian_ply(path, scene(12, 1)), io.read_gaussian_ply),
    "scene.spz": (lambda path: io.write_spz(path, scene(12, 1)), io.read_spz),
    "scene.glb": (lambda path: io.write_gaussian_gltf(path, scene(12, 1)), io.read_gaussian_gltf),
    "scene.gltf": (lambda path: io.write_gaussian_gltf(path, scene(12, 1), compressed=True), io.read_gaussian_gltf),
    "transforms.json": (lambda path: io.write_transforms(path, random_transforms(False, 3)), io.read_transforms),
    "cameras.json": (lambda path: io.write_cameras_json(path, mixed()), io.read_cameras_json),
    **{
        f"{name}{suffix}": (
            lambda path: write(path.parent, small_model(points=20), text=path.suffix == ".txt"),
            lambda path: io.read_colmap(path.parent),
        )
        for name in FILES
        for suffix in (".bin", ".txt")
    },
}


@pytest.mark.parametrize("count", [60, pytest.param(600, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", CASES)
def test_damaged_files_are_refused_or_read(tmp_path: Path, name: str, count: int) -> None:
    make, read = CASES[name]
    path = tmp_path / name
    make(path)
    refused = []
    for damaged in mutations(path.read_bytes(), count):
        path.write_bytes(damaged)
        try:
            read(path)
        except io.FormatError as error:
            refused.append(str(error))
    assert len(refused) > count / 4
    assert all(path.parent.name in message for message in refused)  # they name the file or its folder
