"""Depth Anything 3's camera modules; pose encodings are camera to world."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from backends.poses import encode_pose
from backends.vit import ViTBlock, ViTMLP
from vg2gt.geometry.cameras import invert_rigid, relative_to_first
from vg2gt.types import Cameras

POSE_DIM = 9
MIN_MEDIAN_DISTANCE = 0.1


class CameraDecoder(nn.Module):
    """Camera token ``[B, V, D]`` to pose encoding ``[B, V, 9]``, one shot."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.backbone = nn.Sequential(nn.Linear(dim, dim), nn.ReLU(), nn.Linear(dim, dim), nn.ReLU())
        self.fc_t = nn.Linear(dim, 3)
        self.fc_qvec = nn.Linear(dim, 4)
        self.fc_fov = nn.Sequential(nn.Linear(dim, 2), nn.ReLU())

    def forward(self, camera: Tensor) -> Tensor:
        """Predicts translation, quaternion (xyzw) and fields of view (vertical, horizontal)."""
        features = self.backbone(camera)
        return torch.cat((self.fc_t(features), self.fc_qvec(features), self.fc_fov(features)), -1)


class CameraEncoder(nn.Module):
    """Known cameras to camera tokens ``[B, V, C]``."""

    def __init__(self, dim: int, depth: int, num_heads: int) -> None:
        super().__init__()
        self.trunk = nn.Sequential(*(ViTBlock(dim, num_heads, layer_scale=0.01, eps=1e-5) for _ in range(depth)))
        self.token_norm = nn.LayerNorm(dim, eps=1e-5)
        self.trunk_norm = nn.LayerNorm(dim, eps=1e-5)
        self.pose_branch = ViTMLP(POSE_DIM, dim // 2, dim)

    def forward(self, cameras: Cameras) -> Tensor:
        """Encodes cameras, normalised by :func:`normalize_cameras`."""
        encoding = encode_pose(invert_rigid(cameras.world_to_camera), cameras.intrinsics, cameras.size)
        return self.trunk_norm(self.trunk(self.token_norm(self.pose_branch(encoding))))


def normalize_cameras(cameras: Cameras) -> Cameras:
    """Moves the world into view 0 and divides translations by the median distance of the cameras (at least 0.1)."""
    relative = relative_to_first(cameras)
    distance = invert_rigid(relative.world_to_camera)[..., :3, 3].norm(dim=-1)
    # The lower median by sorting: Tensor.median does not export.
    unit = distance.sort(-1).values[:, (distance.shape[1] - 1) // 2].clamp_min(MIN_MEDIAN_DISTANCE)
    poses = relative.world_to_camera.clone()
    poses[..., :3, 3] /= unit[:, None, None]
    return Cameras(poses, relative.intrinsics, relative.size)
