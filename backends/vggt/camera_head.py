"""VGGT's camera head: refines a pose encoding in a few rounds of attention over the views."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from backends.vit import ViTBlock, ViTMLP

ITERATIONS = 4
POSE_DIM = 9


class CameraHead(nn.Module):
    """Camera tokens of ``dim`` channels to pose encodings, by a trunk of ``depth`` blocks."""

    def __init__(self, dim: int, depth: int, num_heads: int) -> None:
        super().__init__()
        self.empty_pose_tokens = nn.Parameter(torch.zeros(1, 1, POSE_DIM))
        self.trunk = nn.ModuleList(ViTBlock(dim, num_heads, layer_scale=0.01, eps=1e-5) for _ in range(depth))
        self.token_norm = nn.LayerNorm(dim, eps=1e-5)
        self.trunk_norm = nn.LayerNorm(dim, eps=1e-5)
        self.embed_pose = nn.Linear(POSE_DIM, dim)
        self.poseLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(dim, 3 * dim))
        self.pose_branch = ViTMLP(dim, dim // 2, POSE_DIM)

    def forward(self, camera: Tensor) -> Tensor:
        """Maps camera tokens ``[B, V, D]`` to pose encodings ``[B, V, 9]`` (camera from world)."""
        token = self.token_norm(camera)
        raw = torch.zeros_like(token[..., :POSE_DIM])
        for iteration in range(ITERATIONS):
            # The running estimate is an input of the next round, not a path for gradients.
            current = self.empty_pose_tokens.expand_as(raw) if iteration == 0 else raw.detach()
            shift, scale, gate = self.poseLN_modulation(self.embed_pose(current)).chunk(3, -1)
            x = token + gate * (F.layer_norm(token, token.shape[-1:], eps=1e-6) * (1 + scale) + shift)
            for block in self.trunk:
                x = block(x)
            raw = raw + self.pose_branch(self.trunk_norm(x))
        return torch.cat((raw[..., :7], F.relu(raw[..., 7:])), -1)
