"""COLMAP models by pycolmap: round trips, real models by geometry, what people's files look like, damaged files."""

import struct
from pathlib import Path

import numpy as np
import pycolmap  # pyright: ignore[reportMissingImports]
import pytest
import torch

from vg2gt import io
from vg2gt.geometry.cameras import project
from vg2gt.io.colmap import FILES
from vg2gt.types import Cameras

POSE = "1 0 0 0 0 0 0"
CAMERA = "1 PINHOLE 64 48 50 50 32 24\n"


def small_model(points: int = 20):
    return views_model(points)[0]


def views_model(points: int = 60):
    """Points seen by three views of our own, each observed where its source view projects it."""
    rng = np.random.default_rng(1)
    poses = torch.eye(4).repeat(1, 3, 1, 1)
    poses[0, :, 0, 3] = torch.tensor([0.0, -0.3, 0.4])
    intrinsics = torch.tensor([[80.0, 0, 47.5], [0, 82.0, 31.5], [0, 0, 1]]).repeat(1, 3, 1, 1)
    cameras = Cameras(poses, intrinsics, (64, 96))
    xyz = rng.uniform([-0.4, -0.4, 2], [0.4, 0.4, 4], (points, 3))
    views = rng.integers(0, 3, points)
    spread = torch.from_numpy(xyz).float()[None, None].expand(1, 3, -1, -1)
    pixels = project(spread, cameras)[0][0].numpy()[views, np.arange(points)]
    colors = rng.integers(0, 256, (points, 3)).astype(np.uint8)
    observed = np.arange(points), views, pixels
    return io.colmap_from_views(cameras, ["a.png", "b.png", "c.png"], xyz, colors, observed), cameras


def write(folder: Path, model: pycolmap.Reconstruction, text: bool) -> Path:
    if text:
        model.write_text(folder)
        return folder
    return io.write_colmap(folder, model)


def put_text(folder: Path, cameras: str, images: str, points: str | None = "") -> Path:
    for name, text in (("cameras", cameras), ("images", images), ("points3D", points)):
        if text is not None:
            (folder / f"{name}.txt").write_text(text)
    return folder


@pytest.mark.parametrize("text", [False, True])
def test_own_views_come_back(tmp_path: Path, text: bool) -> None:
    model, cameras = views_model()
    found = io.read_colmap(write(tmp_path, model, text))
    images = io.colmap_images(found)
    assert [image.name for image in images] == ["a.png", "b.png", "c.png"]
    for view, image in enumerate(images):
        np.testing.assert_array_equal(io.colmap_pose(image), cameras.world_to_camera[0, view].numpy())
        np.testing.assert_array_equal(io.colmap_intrinsics(image.camera), cameras.intrinsics[0, view].numpy())
        for point in image.get_observation_points2D():
            np.testing.assert_allclose(image.project_point(found.points3D[point.point3D_id].xyz), point.xy, atol=1e-4)
    assert len(found.points3D) == 60
    assert all(point.track.length() == 1 for point in found.points3D.values())


def test_images_are_ordered_as_people_count_and_points_may_be_missing(tmp_path: Path) -> None:
    """Item 11: 1, 10, 2 as text."""
    images = "".join(f"{i} {POSE} 1 room{i % 2}/{i}.png\n\n" for i in range(1, 13))
    model = io.read_colmap(put_text(tmp_path, CAMERA, images, None))
    order = [2, 4, 6, 8, 10, 12, 1, 3, 5, 7, 9, 11]
    assert [image.name for image in io.colmap_images(model)] == [f"room{i % 2}/{i}.png" for i in order]
    assert not model.points3D


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("cameras", ("32 24", "32 -nan(ind)")),  # as Windows writes it
        ("cameras", ("64 48", "0 48")),
        ("images", ("0 0 0 0 1 a", "0 inf 0 0 1 a")),
        ("images", ("1 0 0 0 0", "0 0 0 0 0")),
        ("points3D", ("0 0 4", "0 nan 4")),
        ("points3D", ("0 0 4", "0 1e300 4")),
    ],
)
def test_values_that_are_not_finite_are_refused(tmp_path: Path, name: str, change: tuple[str, str]) -> None:
    put_text(tmp_path, CAMERA, f"7 {POSE} 1 a.png\n32 24 7\n", "7 0 0 4 9 8 7 0.5 7 0\n")
    assert len(io.read_colmap(tmp_path).points3D) == 1
    path = tmp_path / f"{name}.txt"
    path.write_text(path.read_text().replace(*change))
    with pytest.raises(io.FormatError, match=rf"{name}\.txt: .*values that are not finite"):
        io.read_colmap(tmp_path)


def test_names_with_spaces_in_text(tmp_path: Path) -> None:
    model = small_model()
    names = {image.image_id: f"trip/day {image.image_id} of 3.png" for image in model.images.values()}
    for number, name in names.items():
        model.images[number].name = name
    found = io.read_colmap(write(tmp_path, model, text=True))
    assert {image.image_id: image.name for image in found.images.values()} == names


def test_wrong_arguments_are_named() -> None:
    _, cameras = views_model()
    with pytest.raises(ValueError, match=r"names \(1\)"):
        io.colmap_from_views(cameras, ["a.png"])
    with pytest.raises(ValueError, match="uint8"):
        io.colmap_from_views(cameras, ["a", "b", "c"], np.zeros((2, 3)), np.zeros((2, 3)))
    with pytest.raises(ValueError, match="sources must be"):
        io.colmap_from_views(cameras, ["a", "b", "c"], np.zeros((2, 3)), None, ([0], [1], [1, 2]))
    equirectangular = pycolmap.Camera(model="EQUIRECTANGULAR", width=64, height=32, params=[64, 32])
    with pytest.raises(ValueError, match="EQUIRECTANGULAR has no pinhole equivalent"):
        io.colmap_intrinsics(equirectangular)


def test_a_folder_without_a_model_and_a_missing_pycolmap_are_named(tmp_path: Path, monkeypatch) -> None:
    with pytest.raises(io.FormatError, match="no COLMAP model here"):
        io.read_colmap(tmp_path)
    io.write_colmap(tmp_path, small_model())
    monkeypatch.setattr("vg2gt.io.colmap.importlib.util.find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"^reading .* needs pycolmap: pip install 'vg2gt\[colmap\]'$"):
        io.read_colmap(tmp_path)


@pytest.mark.parametrize("name", FILES)
def test_counts_are_not_trusted(tmp_path: Path, name: str) -> None:
    """pycolmap alone would fill the memory for minutes."""
    io.write_colmap(tmp_path, small_model())
    path = tmp_path / f"{name}.bin"
    content = path.read_bytes()
    huge = (b"\xff" * 8 + content[8:], struct.pack("<Q", 1 << 60) + content[8:])
    for damaged in (*huge, content + b"\0", content[:-5], content[:9], b""):
        path.write_bytes(damaged)
        with pytest.raises(io.FormatError, match=rf"{name}\.bin: its records .* truncated or damaged"):
            io.read_colmap(tmp_path)
