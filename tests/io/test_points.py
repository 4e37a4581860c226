"""Points as PLY, and as GLB with cameras, read back with trimesh."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from tests.io.gaussian_scenes import views
from vg2gt.io import write_glb, write_point_ply
from vg2gt.io.points import FRUSTA, POINTS, frusta, scene_extent


def points() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.normal(size=(50, 3)).astype(np.float32), rng.integers(0, 256, (50, 3)).astype(np.uint8)


@pytest.mark.parametrize("count", [0, 1, 50])
def test_points_round_trip(tmp_path: Path, count: int) -> None:
    xyz, rgb = (column[:count] for column in points())
    for colors, expected in ((rgb, rgb), (None, np.full((count, 3), 128))):
        path = write_point_ply(tmp_path / "points.ply", xyz, colors)
        head, body = path.read_bytes().split(b"end_header\n")
        lines = [line.split()[1:] for line in head.decode().splitlines() if line.startswith("property")]
        assert lines == [["float", axis] for axis in "xyz"] + [["uchar", c] for c in ("red", "green", "blue", "alpha")]
        table = np.frombuffer(body, [("xyz", "<f4", 3), ("rgb", "u1", 3), ("alpha", "u1")])
        np.testing.assert_array_equal(table["xyz"], xyz)
        np.testing.assert_array_equal(table["rgb"], expected)


def test_points_and_frusta_stand_upright(tmp_path: Path) -> None:
    xyz, rgb = points()
    scene = trimesh.load(write_glb(tmp_path / "scene.glb", xyz, rgb, views()))
    assert isinstance(scene, trimesh.Scene)
    placed = {}  # world positions of every object of the file, in glTF's axes
    for name in scene.graph.nodes_geometry:
        transform, geometry = scene.graph[name]
        placed[geometry] = trimesh.transform_points(scene.geometry[geometry].vertices, transform)
    np.testing.assert_allclose(placed[POINTS], xyz * [1, -1, -1], atol=1e-6)
    np.testing.assert_array_equal(scene.geometry[POINTS].colors[:, :3], rgb)
    centers = torch.linalg.inv(views().world_to_camera[0])[:, :3, 3].double().numpy()
    depth = 0.05 * scene_extent(xyz.astype(np.float64), centers)
    corners = frusta(views(), depth).reshape(-1, 3) * [1, -1, -1]
    distance = np.linalg.norm(placed[FRUSTA][:, None] - corners[None], axis=-1)
    assert distance.min(1).max() < 1e-6
    assert distance.min(0).max() < 1e-6


def test_frusta_are_the_images_outlines() -> None:
    cameras = views((40, 56))
    corners = torch.from_numpy(frusta(cameras, 2.0))
    for view in range(3):
        pose = cameras.world_to_camera[0, view].double()
        local = corners[view] @ pose[:3, :3].T + pose[:3, 3]
        assert local[0].abs().max() < 1e-6
        torch.testing.assert_close(local[1:, 2], torch.full((5,), 2.0, dtype=torch.float64))
        pixels = (local / local[:, 2:]) @ cameras.intrinsics[0, view].double().T
        expected = torch.tensor([[-0.5, -0.5], [55.5, -0.5], [55.5, 39.5], [-0.5, 39.5], [27.5, -10.5]]).double()
        torch.testing.assert_close(pixels[1:, :2], expected, atol=1e-4, rtol=0)


def test_points_that_cannot_be_written_are_named(tmp_path: Path) -> None:
    for message, xyz, colors in (
        (r"positions must be \[N, 3\]", np.zeros((4, 2)), None),
        (r"uint8 \[N, 3\], got \[4, 3\] and float64", np.zeros((4, 3)), np.zeros((4, 3))),
        ("positions must be finite", np.full((4, 3), np.nan), None),
    ):
        with pytest.raises(ValueError, match=message):
            write_point_ply(tmp_path / "points.ply", xyz, colors)
    assert not (tmp_path / "points.ply").exists()
