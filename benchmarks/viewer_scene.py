"""A scene to look at: a procedural room as coloured voxels, ``python benchmarks/viewer_scene.py FOLDER``.

Writes ``scene.ply``, ``cameras.json`` and the images it was made of, as `vg2gt view` takes them: one Gaussian per
voxel, a little larger than its cell, in the mean colour of the pixels that fall into it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from torch import Tensor

from vg2gt.data.synthetic import SyntheticScenes
from vg2gt.geometry.cameras import invert_rigid, ray_directions, transform_points
from vg2gt.geometry.spherical_harmonics import rgb_to_sh
from vg2gt.io import named_cameras, write_cameras_json, write_gaussian_ply
from vg2gt.io.images import write_png
from vg2gt.method.grid import plan_voxels, pool_mean
from vg2gt.types import Cameras, Gaussians

SIGMA_SHARE = 0.6  # of a voxel's edge, the standard deviation of its Gaussian
OPACITY = 0.95


def voxel_room(
    seed: int = 2, views: int = 12, size: tuple[int, int] = (240, 320), voxel_size: float = 0.06
) -> tuple[Gaussians, Cameras, Tensor]:
    """Makes the scene.

    Args:
        seed: of the room.
        views: number of views along the camera path.
        size: image ``(height, width)``.
        voxel_size: edge length in metres.

    Returns:
        The Gaussians, the views ``[1, V]`` and their images ``[V, 3, H, W]`` in [0, 1].
    """
    source = SyntheticScenes(1, seed, views, size)
    (name,) = source.scenes
    frames = source.load(name, range(views))
    images, depth = frames.images, frames.depth
    cameras = Cameras(frames.world_to_camera[None], frames.intrinsics[None], size)
    rays = ray_directions(cameras.intrinsics, size)
    points = transform_points(invert_rigid(cameras.world_to_camera), rays * depth[None, ..., None]).reshape(-1, 3)
    plan = plan_voxels(points / voxel_size, torch.zeros(len(points), dtype=torch.int64), depth.flatten() > 0)
    values = torch.cat((points, images.permute(0, 2, 3, 1).reshape(-1, 3)), -1)
    means, colors = pool_mean(values, torch.ones(len(points)), plan).split(3, -1)
    count = len(plan)
    return (
        Gaussians(
            means.contiguous(),
            torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
            torch.full((count, 3), SIGMA_SHARE * voxel_size),
            torch.full((count,), OPACITY),
            rgb_to_sh(colors)[:, None],
            torch.zeros(count, dtype=torch.int64),
        ),
        cameras,
        images,
    )


def main() -> None:
    """Writes the scene's files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--voxel-size", type=float, default=0.02)
    arguments = parser.parse_args()
    gaussians, cameras, images = voxel_room(size=(480, 640), voxel_size=arguments.voxel_size)
    names = [f"{index:02d}.png" for index in range(len(images))]
    for name, image in zip(names, images, strict=True):
        write_png(arguments.folder / name, image)
    write_cameras_json(arguments.folder / "cameras.json", named_cameras(cameras, names))
    print(write_gaussian_ply(arguments.folder / "scene.ply", gaussians), len(gaussians), "Gaussians")


if __name__ == "__main__":
    main()
