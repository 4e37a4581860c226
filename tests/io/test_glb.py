"""GLB of points and cameras, read back with trimesh."""

from pathlib import Path

import numpy as np
import torch
import trimesh

from tests.io.gaussian_scenes import views
from vg2gt.io import write_glb
from vg2gt.io.glb import FRUSTA, POINTS, frusta


def load(path: Path) -> tuple[dict[str, np.ndarray], trimesh.Scene]:
    """World positions of every object of the file, in glTF's axes."""
    scene = trimesh.load(path)
    assert isinstance(scene, trimesh.Scene)
    placed = {}
    for name in scene.graph.nodes_geometry:
        transform, geometry = scene.graph[name]
        placed[geometry] = trimesh.transform_points(scene.geometry[geometry].vertices, transform)
    return placed, scene


def test_points_and_frusta_stand_upright(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    xyz = rng.normal(size=(50, 3)).astype(np.float32)
    rgb = rng.integers(0, 256, (50, 3)).astype(np.uint8)
    path = write_glb(tmp_path / "scene.glb", xyz, rgb, views(), frustum_depth=0.3)
    placed, scene = load(path)
    np.testing.assert_allclose(placed[POINTS], xyz * [1, -1, -1], atol=1e-6)
    np.testing.assert_array_equal(scene.geometry[POINTS].colors[:, :3], rgb)
    corners = frusta(views(), 0.3).reshape(-1, 3) * [1, -1, -1]
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
