"""Pinhole geometry: pixels, rays, points, rigid transforms, intrinsics under resize and crop."""

from __future__ import annotations

import torch
from torch import Tensor

from vg2gt.types import Cameras


def pixel_grid(height: int, width: int, like: Tensor) -> Tensor:
    """Returns integer pixel centres ``[H, W, 2]`` as (x, y), in the dtype and on the device of ``like``."""
    y, x = torch.meshgrid(
        torch.arange(height, dtype=like.dtype, device=like.device),
        torch.arange(width, dtype=like.dtype, device=like.device),
        indexing="ij",
    )
    return torch.stack((x, y), -1)


def focal_lengths(intrinsics: Tensor) -> Tensor:
    """Returns ``[..., 2]`` (fx, fy) of ``[..., 3, 3]``; unlike indexing with lists, never synchronises with a GPU."""
    return torch.stack((intrinsics[..., 0, 0], intrinsics[..., 1, 1]), -1)


def ray_directions(intrinsics: Tensor, size: tuple[int, int]) -> Tensor:
    """Returns camera-frame ray directions with unit z.

    Args:
        intrinsics: ``[..., 3, 3]`` in pixels, integer pixel centres.
        size: image ``(height, width)``.

    Returns:
        ``[..., H, W, 3]``; multiply by z-depth to get camera-frame points.
    """
    pixels = pixel_grid(*size, like=intrinsics)
    focal, center = focal_lengths(intrinsics)[..., None, None, :], intrinsics[..., None, None, :2, 2]
    xy = (pixels - center) / focal
    return torch.cat((xy, torch.ones_like(xy[..., :1])), -1)


def compose(first: Tensor, second: Tensor) -> Tensor:
    """Multiplies small matrices ``[..., I, J]`` and ``[..., J, K]`` elementwise, so that autocast cannot round them."""
    return (first[..., :, :, None] * second[..., None, :, :]).sum(-2)


def invert_rigid(transform: Tensor) -> Tensor:
    """Inverts rigid 4x4 transforms ``[..., 4, 4]`` by transposing the rotation."""
    rotation = transform[..., :3, :3].transpose(-1, -2)
    translation = -compose(rotation, transform[..., :3, 3:])
    return torch.cat((torch.cat((rotation, translation), -1), transform[..., 3:, :]), -2)


def rigid_motions(turns: Tensor, shifts: Tensor) -> Tensor:
    """Returns the matrices of rigid motions.

    Args:
        turns: ``[..., 3]`` rotation vectors in rad.
        shifts: ``[..., 3]`` translations, applied after the rotation.

    Returns:
        ``[..., 4, 4]``.
    """
    skew = turns.new_zeros(*turns.shape[:-1], 3, 3)
    for axis, (i, j) in enumerate(((2, 1), (0, 2), (1, 0))):
        skew[..., i, j], skew[..., j, i] = turns[..., axis], -turns[..., axis]
    motions = torch.eye(4, dtype=turns.dtype, device=turns.device).repeat(*turns.shape[:-1], 1, 1)
    motions[..., :3, :3] = torch.matrix_exp(skew)
    motions[..., :3, 3] = shifts
    return motions


def transform_points(transform: Tensor, points: Tensor) -> Tensor:
    """Applies rigid transforms ``[B, V, 4, 4]`` to points ``[B, V, ..., 3]``.

    Elementwise, so that neither autocast nor TF32 can round positions (2 mm voxels need full float32 precision).
    """
    shape = transform.shape[:-2] + (1,) * (points.dim() - transform.dim() + 1)
    columns = transform[..., :3, :].unbind(-1)
    rotation_x, rotation_y, rotation_z, translation = (column.reshape(*shape, 3) for column in columns)
    x, y, z = points.split(1, -1)
    return torch.addcmul(torch.addcmul(torch.addcmul(translation, rotation_x, x), rotation_y, y), rotation_z, z)


def unproject(depth: Tensor, cameras: Cameras) -> Tensor:
    """Lifts z-depth to world points.

    Args:
        depth: ``[B, V, H, W]``; pixels with depth 0 land on the camera centre, so mask them.
        cameras: cameras of the same views and size.

    Returns:
        ``[B, V, H, W, 3]`` in the cameras' world frame.
    """
    rays = ray_directions(cameras.intrinsics, (depth.shape[-2], depth.shape[-1]))
    return transform_points(invert_rigid(cameras.world_to_camera), rays * depth[..., None])


def project(points: Tensor, cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Projects world points into every view.

    Args:
        points: ``[B, V, ..., 3]`` world points, one set per view.
        cameras: the views.

    Returns:
        Pixels ``[B, V, ..., 2]`` as (x, y) and z-depth ``[B, V, ...]``.
    """
    local = transform_points(cameras.world_to_camera, points)
    depth = local[..., 2]
    shape = cameras.intrinsics.shape[:2] + (1,) * (points.dim() - 3)
    focal = focal_lengths(cameras.intrinsics).reshape(*shape, 2)
    center = cameras.intrinsics[..., :2, 2].reshape(*shape, 2)
    return local[..., :2] / depth[..., None] * focal + center, depth


def relative_to_first(cameras: Cameras) -> Cameras:
    """Makes view 0 of every scene the world frame; its pose becomes exactly the identity."""
    first = invert_rigid(cameras.world_to_camera[:, :1])
    poses = compose(cameras.world_to_camera, first)
    identity = torch.eye(4, dtype=poses.dtype, device=poses.device).expand_as(poses[:, :1])
    return Cameras(torch.cat((identity, poses[:, 1:]), 1), cameras.intrinsics, cameras.size)


def scale_translations(cameras: Cameras, scale: Tensor) -> Cameras:
    """Multiplies the cameras' translations by one factor ``[B]`` per scene."""
    poses = cameras.world_to_camera
    translation = poses[..., :3, 3:] * scale[:, None, None, None]
    top = torch.cat((poses[..., :3, :3], translation), -1)
    return Cameras(torch.cat((top, poses[..., 3:, :]), -2), cameras.intrinsics, cameras.size)


def resize_intrinsics(intrinsics: Tensor, scale_x: float, scale_y: float) -> Tensor:
    """Returns the intrinsics ``[..., 3, 3]`` of an image resized by the given factors (integer pixel centres).

    A point at c moves to ``s * (c + 1/2) - 1/2``, because resizing maps pixel areas, not pixel centres.
    """
    out = intrinsics.clone()
    for axis, scale in enumerate((scale_x, scale_y)):
        out[..., axis, axis] = intrinsics[..., axis, axis] * scale
        out[..., axis, 2] = (intrinsics[..., axis, 2] + 0.5) * scale - 0.5
    return out


def crop_intrinsics(intrinsics: Tensor, left: int, top: int) -> Tensor:
    """Returns the intrinsics ``[..., 3, 3]`` of an image cropped so that pixel (left, top) becomes (0, 0)."""
    out = intrinsics.clone()
    out[..., 0, 2] -= left
    out[..., 1, 2] -= top
    return out


def strided_intrinsics(intrinsics: Tensor, step_x: int, step_y: int) -> Tensor:
    """Returns the intrinsics ``[..., 3, 3]`` of every ``step``-th pixel from ``step // 2`` on, along both axes.

    Sampling scales the centres of pixels, unlike resizing (:func:`resize_intrinsics`), which scales their areas.
    """
    out = crop_intrinsics(intrinsics, step_x // 2, step_y // 2)
    out[..., 0, :] /= step_x
    out[..., 1, :] /= step_y
    return out


def camera_centers(cameras: Cameras) -> Tensor:
    """Returns camera centres ``[B, V, 3]`` in the world frame."""
    pose = cameras.world_to_camera
    return -compose(pose[..., :3, :3].transpose(-1, -2), pose[..., :3, 3:])[..., 0]
