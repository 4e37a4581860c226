"""TSDF fusion and surface nets against surfaces known in closed form."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from trimesh.visual import ColorVisuals

from vg2gt.geometry.cameras import ray_directions
from vg2gt.io import fuse_depth, write_mesh
from vg2gt.types import Cameras

RADIUS = 0.7
VOXEL = 0.05


def looking_at_origin(views: int, distance: float, size: tuple[int, int]) -> Cameras:
    """Cameras evenly over the sphere (a golden spiral), all looking at the origin."""
    i = torch.arange(views) + 0.5
    z, turn = 1 - 2 * i / views, i * 2.399963
    center = distance * torch.stack(((1 - z**2).sqrt() * turn.cos(), (1 - z**2).sqrt() * turn.sin(), z), -1)
    forward = -center / distance
    right = torch.linalg.cross(forward, torch.tensor([0.3, 0.5, 0.8]).expand_as(forward))
    right = right / right.norm(dim=-1, keepdim=True)
    rotation = torch.stack((right, torch.linalg.cross(forward, right), forward), 1)
    poses = torch.eye(4).repeat(views, 1, 1)
    poses[:, :3, :3] = rotation
    poses[:, :3, 3] = -(rotation @ center[:, :, None])[:, :, 0]
    height, width = size
    k = torch.tensor([[1.1 * width, 0, (width - 1) / 2], [0, 1.1 * width, (height - 1) / 2], [0, 0, 1]])
    return Cameras(poses[None], k.repeat(1, views, 1, 1), size)


def sphere_depth(cameras: Cameras) -> torch.Tensor:
    """z-depth of a sphere about the origin, 0 elsewhere."""
    rays = ray_directions(cameras.intrinsics, cameras.size)[0]
    origin = cameras.world_to_camera[0, :, None, None, :3, 3]
    a, b = (rays**2).sum(-1), (rays * origin).sum(-1)
    root = b**2 - a * ((origin**2).sum(-1) - RADIUS**2)
    return torch.where(root > 0, (b - root.clamp(min=0).sqrt()) / a, 0.0)


@pytest.fixture(scope="module")
def sphere():
    cameras = looking_at_origin(16, 2.5, (72, 72))
    depth = sphere_depth(cameras)
    colors = torch.zeros(16, 3, 72, 72)
    colors[:, 0] = 1
    return cameras, depth, colors, fuse_depth(depth, cameras, colors, voxel_size=VOXEL)


def test_sphere_lies_within_a_voxel_and_is_closed(sphere) -> None:
    *_, mesh = sphere
    error = np.abs(np.linalg.norm(mesh.vertices, axis=-1) - RADIUS)
    assert error.max() < VOXEL
    assert error.mean() < 0.05 * VOXEL
    body = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    _, neighbours = np.unique(body.edges_sorted, axis=0, return_counts=True)
    assert (neighbours % 2 == 0).all()  # closed
    assert body.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.01)  # positive: faces look outwards
    assert (mesh.colors == [255, 0, 0]).all()


def test_depth_edges_make_no_bridges() -> None:
    """A near square in front of a far wall: nothing is invented between the two."""
    depth = torch.full((1, 48, 64), 3.0)
    depth[:, 16:32, 20:40] = 1.5
    k = torch.tensor([[50.0, 0, 31.5], [0, 50, 23.5], [0, 0, 1]])
    cameras = Cameras(torch.eye(4)[None, None], k[None, None], (48, 64))
    mesh = fuse_depth(depth, cameras, torch.rand(1, 3, 48, 64), voxel_size=0.05)
    distance = np.minimum(np.abs(mesh.vertices[:, 2] - 3), np.abs(mesh.vertices[:, 2] - 1.5))
    assert distance.max() < 0.05
    assert {round(float(z), 1) for z in np.unique(mesh.vertices[:, 2])} == {1.5, 3.0}


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_written_meshes_load(tmp_path: Path, sphere, suffix: str) -> None:
    *_, mesh = sphere
    mesh.colors[:] = 188
    path = write_mesh(tmp_path / f"sphere{suffix}", mesh)
    loaded = trimesh.load_mesh(path)
    assert isinstance(loaded.visual, ColorVisuals)
    assert set(loaded.visual.vertex_colors[:, :3].flatten()) == {128 if suffix == ".glb" else 188}  # glTF: linear
    assert len(loaded.faces) == len(mesh.faces)
    vertices = mesh.vertices * ([1, -1, -1] if suffix == ".glb" else 1)  # glTF: y up
    np.testing.assert_allclose(loaded.bounds, [vertices.min(0), vertices.max(0)], atol=1e-5)


def test_inputs_are_not_changed_and_errors_name_the_knob(tmp_path: Path, sphere, monkeypatch) -> None:
    cameras, depth, colors, _ = sphere
    before = depth.clone()
    for message, changes in {
        "take larger voxels": {"voxel_size": 1e-7},
        "voxel_size must be positive": {"voxel_size": 0},
        r"depth and colors must be \[\(16, 72, 72\)": {"depth": depth[:, :50]},
        "depth has values that are not finite": {"depth": depth / 0},
    }.items():
        with pytest.raises(ValueError, match=message):
            fuse_depth(**{"depth": depth, "cameras": cameras, "colors": colors, "voxel_size": VOXEL, **changes})
    assert torch.equal(depth, before)
    monkeypatch.setattr("vg2gt.io.mesh.MAX_VOXELS", 1000)
    with pytest.raises(ValueError, match="more than 1000 voxels"):
        fuse_depth(depth, cameras, colors, voxel_size=VOXEL)
    empty = fuse_depth(depth * 0, cameras, colors, voxel_size=VOXEL)
    assert empty.vertices.shape == (0, 3)
    with pytest.raises(ValueError, match="the mesh is empty"):
        write_mesh(tmp_path / "empty.ply", empty)
    with pytest.raises(ValueError, match=r"written as one of \.ply"):
        write_mesh(tmp_path / "empty.fbx", empty)
