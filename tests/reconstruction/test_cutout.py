"""``--object``: what all cameras look at stays, what surrounds it goes."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from vg2gt.outputs.outputs import write_outputs
from vg2gt.reconstruction.camera_path import look_at
from vg2gt.reconstruction.cutout import cut_to_object
from vg2gt.reconstruction.scene import Scene
from vg2gt.rendering import Renderer
from vg2gt.types import Cameras, Gaussians

SIZE = (48, 64)


def orbit(target: np.ndarray, turned: float = 0.0) -> Cameras:
    """Twelve cameras at a distance of 3, 1 above; turned away from the target by an angle."""
    poses = []
    for angle in np.arange(12) * math.pi / 6:
        center = target + np.array([3 * math.sin(angle), -1, -3 * math.cos(angle)])
        aim = center + np.array([-math.sin(angle + turned), 0.3, math.cos(angle + turned)])
        poses.append(look_at(center, aim, np.array([0.0, 1, 0])))
    intrinsics = torch.tensor([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]])
    return Cameras(torch.from_numpy(np.stack(poses)).float()[None], intrinsics.expand(1, 12, 3, 3).clone(), SIZE)


def parts() -> dict[str, torch.Tensor]:
    """A ball of radius .4, a wall around at 8, debris near the cameras and between these and the ball."""
    generator = torch.Generator().manual_seed(0)

    def sphere(count: int, radius: float) -> torch.Tensor:
        return radius * torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)

    return {"ball": sphere(3000, 0.4), "wall": sphere(2000, 8), "near": sphere(60, 3), "between": sphere(60, 1.4)}


def scene(target: list[float], cameras: Cameras) -> Scene:
    means = torch.cat(list(parts().values())) + torch.tensor(target)
    count = len(means)
    gaussians = Gaussians(
        means,
        torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        torch.where(means.sub(torch.tensor(target)).norm(dim=1) > 7, 0.15, 0.04)[:, None].repeat(1, 3),
        torch.full((count,), 0.95),
        torch.zeros(count, 1, 3),
        torch.zeros(count, dtype=torch.int64),
    )
    blank = torch.zeros(12, *SIZE)
    made = Scene(gaussians, cameras, torch.zeros(12, 3, *SIZE), blank, blank, tuple("abcdefghijkl"), Renderer())
    depth = torch.stack([view.depth for view in made.render()])
    return Scene(gaussians, cameras, made.images, depth, torch.ones_like(depth), made.names, Renderer())


@pytest.mark.parametrize("target", [[0.0, 0, 0], [5.0, -2, 9]])
def test_only_the_object_stays(target: list[float]) -> None:
    before = scene(target, orbit(np.array(target)))
    after = cut_to_object(before)
    distance = (after.gaussians.means - torch.tensor(target)).norm(dim=1)
    assert (distance < 0.5).sum() >= 0.99 * len(parts()["ball"])
    assert (distance >= 0.5).sum() == 0
    seen = after.depth > 0
    assert seen.any()
    assert (after.depth[seen] < 3.9).all()  # the wall's depth has gone with it
    assert (before.depth > 6).any()


def test_the_mesh_of_an_object_is_closed(tmp_path: Path) -> None:
    """Its lower side, which no camera sees, too."""
    target = np.array([5.0, -2, 9])
    whole = scene(target.tolist(), orbit(target))
    write_outputs(cut_to_object(whole), tmp_path / "object", ["mesh.ply"], mesh_voxel=0.03)
    write_outputs(replace(cut_to_object(whole), is_object=False), tmp_path / "open", ["mesh.ply"], mesh_voxel=0.03)
    surface = trimesh.load_mesh(tmp_path / "open" / "mesh.ply")
    assert not surface.is_watertight
    radius = float(np.median(np.linalg.norm(surface.vertices - target, axis=1)))  # Gaussians are thick
    assert 0.4 < radius < 0.52
    mesh = trimesh.load_mesh(tmp_path / "object" / "mesh.ply")
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert len(mesh.split()) == 1
    assert mesh.volume == pytest.approx(4 / 3 * math.pi * radius**3, rel=0.05)
    distance = np.linalg.norm(mesh.vertices - target, axis=1)
    assert np.abs(distance / radius - 1).max() < 0.1


def test_a_room_is_no_object() -> None:
    inside = orbit(np.zeros(3), turned=math.pi)
    with pytest.raises(ValueError, match="do not look at one object"):
        cut_to_object(scene([0.0, 0, 0], inside))
