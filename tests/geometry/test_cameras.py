import numpy as np
import torch
from torch import Tensor

from vg2gt.geometry.cameras import (
    crop_intrinsics,
    invert_rigid,
    pixel_grid,
    project,
    ray_directions,
    relative_to_first,
    resize_intrinsics,
    scale_translations,
    transform_points,
    unproject,
)
from vg2gt.geometry.rotations import quat_to_matrix
from vg2gt.types import Cameras

SIZE = (6, 8)


def random_cameras(scenes: int = 2, views: int = 3, seed: int = 0) -> Cameras:
    generator = torch.Generator().manual_seed(seed)
    poses = torch.eye(4, dtype=torch.float64).repeat(scenes, views, 1, 1)
    poses[..., :3, :3] = quat_to_matrix(torch.randn(scenes, views, 4, generator=generator, dtype=torch.float64))
    poses[..., :3, 3] = torch.randn(scenes, views, 3, generator=generator, dtype=torch.float64)
    intrinsics = torch.tensor([[7.0, 0, 3.6], [0, 6, 2.4], [0, 0, 1]], dtype=torch.float64).repeat(scenes, views, 1, 1)
    intrinsics[..., 0, 0] += torch.arange(views)
    return Cameras(poses, intrinsics, SIZE)


def random_depth(scenes: int = 2, views: int = 3) -> Tensor:
    return 1 + torch.rand(scenes, views, *SIZE, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def test_unprojection_by_hand_and_back() -> None:
    cameras, depth = random_cameras(), random_depth()
    points = unproject(depth, cameras)
    b, v, y, x = 1, 2, 4, 5
    homogeneous = np.linalg.inv(cameras.intrinsics[b, v].numpy()) @ np.array([x, y, 1.0]) * float(depth[b, v, y, x])
    world = np.linalg.inv(cameras.world_to_camera[b, v].numpy()) @ np.append(homogeneous, 1)
    np.testing.assert_allclose(points[b, v, y, x].numpy(), world[:3], rtol=1e-12)
    pixels, z = project(points, cameras)
    torch.testing.assert_close(pixels, pixel_grid(*SIZE, depth).expand_as(pixels))
    torch.testing.assert_close(z, depth)


def test_rigid_inverse_and_points() -> None:
    poses = random_cameras().world_to_camera
    torch.testing.assert_close(invert_rigid(poses), torch.linalg.inv(poses))
    points = torch.randn(2, 3, 4, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    expected = torch.einsum("bvij,bvnj->bvni", poses[..., :3, :3], points) + poses[:, :, None, :3, 3]
    torch.testing.assert_close(transform_points(poses, points), expected)
    torch.testing.assert_close(transform_points(poses, points[:, :, 0]), expected[:, :, 0])


def test_relative_cameras_start_at_the_exact_identity_and_scaled_ones_scale_the_world() -> None:
    cameras, depth = random_cameras(), random_depth()
    relative = relative_to_first(cameras)
    assert torch.equal(relative.world_to_camera[:, 0], torch.eye(4, dtype=torch.float64).expand(2, 4, 4))
    points, moved = unproject(depth, cameras), unproject(depth, relative)
    first = cameras.world_to_camera[:, :1].expand(2, 3, 4, 4)
    torch.testing.assert_close(transform_points(first, points), moved)
    torch.testing.assert_close(project(moved, relative)[0], project(points, cameras)[0])
    factor = torch.tensor([2.0, 0.5], dtype=torch.float64)
    shape = (2, 1, 1, 1)
    scaled = unproject(depth * factor.view(shape), scale_translations(cameras, factor))
    torch.testing.assert_close(scaled, points * factor.view(*shape, 1))


def test_resized_intrinsics_map_pixel_areas_and_cropped_ones_keep_the_rays() -> None:
    intrinsics = torch.tensor([[7.0, 0, 3.5], [0, 6, 2.5], [0, 0, 1]])  # the centre of 8 x 6 pixels
    doubled = resize_intrinsics(intrinsics, 2, 2)
    torch.testing.assert_close(doubled, torch.tensor([[14.0, 0, 7.5], [0, 12, 5.5], [0, 0, 1]]))
    torch.testing.assert_close(resize_intrinsics(doubled, 0.5, 0.5), intrinsics)
    assert intrinsics[0, 2] == 3.5  # the argument is left alone
    intrinsics = random_cameras().intrinsics
    for left, top in ((0, 0), (3, 1)):
        cropped = ray_directions(crop_intrinsics(intrinsics, left, top), (SIZE[0] - top, SIZE[1] - left))
        torch.testing.assert_close(cropped, ray_directions(intrinsics, SIZE)[..., top:, left:, :])
