"""Nine-number pose encodings: translation, quaternion (xyzw), vertical and horizontal field of view in radians."""

from __future__ import annotations

import torch
from torch import Tensor

from backends.positions import size_tensor
from vg2gt.geometry.rotations import matrix_to_quat, quat_to_matrix

MIN_TANGENT = 1e-6  # a field of view of 0 would make the focal length infinite


def encode_pose(transform: Tensor, intrinsics: Tensor, size: tuple[int, int]) -> Tensor:
    """Encodes rigid transforms ``[..., 4, 4]`` and intrinsics ``[..., 3, 3]`` as ``[..., 9]``; w >= 0."""
    quats = matrix_to_quat(transform[..., :3, :3])
    fields = 2 * torch.atan(size_tensor(size, like=intrinsics) / 2 / intrinsics[..., [1, 0], [1, 0]])
    return torch.cat((transform[..., :3, 3], quats[..., [1, 2, 3, 0]], fields), -1)


def decode_pose(encoding: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Decodes ``[..., 9]`` into a rigid transform ``[..., 4, 4]`` and intrinsics ``[..., 3, 3]`` in pixels.

    The principal point is (W/2, H/2) in integer pixel coordinates, as published.
    """
    rotation = quat_to_matrix(encoding[..., [6, 3, 4, 5]])
    top = torch.cat((rotation, encoding[..., :3, None]), -1)
    last = torch.zeros_like(top[..., :1, :])
    last[..., 3] = 1
    transform = torch.cat((top, last), -2)

    half = size_tensor(size, like=encoding).flip(0) / 2
    focal = half / torch.tan(encoding[..., [8, 7]] / 2).clamp_min(MIN_TANGENT)
    center = torch.cat((half, half.new_ones(1))).expand(*encoding.shape[:-1], 3)
    axes = torch.diag_embed(torch.cat((focal, torch.zeros_like(focal[..., :1])), -1))[..., :2]
    return transform, torch.cat((axes, center[..., None]), -1)
