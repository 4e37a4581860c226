"""VGGT: a DINOv2 encoder per view, then alternating attention within and across views.

Module names follow the published weight file (``facebook/VGGT-1B``).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from backends.dpt import DPT, decode_geometry
from backends.network import NetworkBackend, decode_pose, normalize_images, predict
from backends.positions import grid_positions, resize_position_embedding, rotary_2d
from backends.published import network_named
from backends.vit import PatchEmbed, ViTBlock, ViTMLP, first_and_others
from backends.weights import Weights
from vg2gt.geometry.precision import full_precision, half_precision_on_gpu
from vg2gt.types import Cameras, Geometry, Hints, Tokens

_IGNORABLE = ("track_head.", "point_head.", "aggregator.patch_embed.mask_token")
_ITERATIONS = 4
POSE_DIM = 9


class _CameraHead(nn.Module):
    """Decodes camera tokens of ``dim`` channels into pose encodings, iteratively, with a trunk of ``depth`` blocks."""

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
        for iteration in range(_ITERATIONS):
            # The current estimate is an input of the next iteration, without gradient.
            current = self.empty_pose_tokens.expand_as(raw) if iteration == 0 else raw.detach()
            shift, scale, gate = self.poseLN_modulation(self.embed_pose(current)).chunk(3, -1)
            x = token + gate * (F.layer_norm(token, token.shape[-1:], eps=1e-6) * (1 + scale) + shift)
            for block in self.trunk:
                x = block(x)
            raw = raw + self.pose_branch(self.trunk_norm(x))
        return torch.cat((raw[..., :7], F.relu(raw[..., 7:])), -1)


REGISTERS = 4


class _Encoder(nn.Module):
    """DINOv2 with registers; returns only patch tokens."""

    def __init__(self, dim: int, depth: int, num_heads: int, image_size: int, patch_size: int) -> None:
        super().__init__()
        self.cls_token = nn.Parameter(torch.zeros(1, 1, dim).normal_(std=0.02))
        self.pos_embed = nn.Parameter(torch.zeros(1, (image_size // patch_size) ** 2 + 1, dim).normal_(std=0.02))
        self.register_tokens = nn.Parameter(torch.zeros(1, REGISTERS, dim).normal_(std=0.02))
        self.patch_embed = PatchEmbed(patch_size, dim)
        self.blocks = nn.ModuleList(ViTBlock(dim, num_heads) for _ in range(depth))
        self.norm = nn.LayerNorm(dim, eps=1e-6)

    def forward(self, images: Tensor, grid: tuple[int, int]) -> Tensor:
        """Maps normalised images ``[N, 3, H, W]`` to patch tokens ``[N, P, C]``."""
        x = self.patch_embed(images) + resize_position_embedding(self.pos_embed[0, 1:], grid, "size")
        first = self.cls_token + self.pos_embed[:, :1]
        special = torch.cat((first, self.register_tokens), 1).expand(x.shape[0], -1, -1)
        x = torch.cat((special.to(x.dtype), x), 1)
        for block in self.blocks:
            x = block(x)
        return self.norm(x)[:, 1 + REGISTERS :]


class _Aggregator(nn.Module):
    """Encoder, special tokens, and alternating within-view (frame) and across-view (global) blocks."""

    def __init__(
        self, dim: int, depth: int, encoder_depth: int, num_heads: int, image_size: int, patch_size: int
    ) -> None:
        super().__init__()
        self.patch_size = patch_size
        self.head_dim = dim // num_heads
        self.camera_token = nn.Parameter(torch.zeros(1, 2, 1, dim).normal_(std=0.02))  # first view, other views
        self.register_token = nn.Parameter(torch.zeros(1, 2, REGISTERS, dim).normal_(std=0.02))
        self.patch_embed = _Encoder(dim, encoder_depth, num_heads, image_size, patch_size)
        self.frame_blocks = nn.ModuleList(_alternating_block(dim, num_heads) for _ in range(depth))
        self.global_blocks = nn.ModuleList(_alternating_block(dim, num_heads) for _ in range(depth))

    def forward(self, images: Tensor, taps: Sequence[int]) -> tuple[list[Tensor], Tensor]:
        """Encodes views.

        Args:
            images: ``[B, V, 3, H, W]`` in [0, 1].
            taps: indices of the tapped block pairs.

        Returns:
            Patch tokens ``[B, V, P, 2C]`` of every tap and the last camera token ``[B, V, 2C]``.
        """
        # images to tokens, special ones first: [B V, N, C]
        batch, views = images.shape[:2]
        grid = (images.shape[-2] // self.patch_size, images.shape[-1] // self.patch_size)
        patches = self.patch_embed(normalize_images(images).flatten(0, 1), grid)
        special = first_and_others(torch.cat((self.camera_token, self.register_token), 2), views)
        special = special.expand(batch, -1, -1, -1).flatten(0, 1).to(patches.dtype)
        x = torch.cat((special, patches), 1)
        count, start = x.shape[1], special.shape[1]

        # rotary tables
        positions = grid_positions(*grid, x.device) + 1  # position 0 is for the special tokens
        positions = torch.cat((positions.new_zeros(start, 2), positions))
        frame_rotary = rotary_2d(positions, self.head_dim)
        global_rotary = tuple(table.repeat(views, 1) for table in frame_rotary)
        # alternate between attention within views and across views
        tapped, camera = [], x
        last = len(self.frame_blocks) - 1
        for index, (frame_block, global_block) in enumerate(zip(self.frame_blocks, self.global_blocks, strict=True)):
            within = frame_block(x, frame_rotary)
            across = global_block(within.reshape(batch, views * count, -1), (global_rotary[0], global_rotary[1]))
            x = across.reshape(batch * views, count, -1)
            if index in taps or index == last:
                both = torch.cat((within, x), -1).unflatten(0, (batch, views))  # [B, V, N, 2C]
                camera = both[:, :, 0]
                if index in taps:
                    tapped.append(both[:, :, start:])
        return tapped, camera


def _alternating_block(dim: int, num_heads: int) -> ViTBlock:
    return ViTBlock(dim, num_heads, qk_norm=True, layer_scale=0.01, eps=1e-5)


class VGGTDecoder(nn.Module):
    """Camera and depth head; names and shapes as published."""

    def __init__(
        self,
        token_dim: int,
        features: int,
        out_channels: Sequence[int],
        patch_size: int,
        camera_depth: int,
        camera_heads: int,
    ) -> None:
        super().__init__()
        sizes = {"token_dim": token_dim, "features": features, "patch_size": patch_size}
        sizes |= {"camera_depth": camera_depth, "camera_heads": camera_heads}
        self.arguments: dict[str, Any] = {**sizes, "out_channels": list(out_channels)}
        self.camera_head = _CameraHead(token_dim, camera_depth, camera_heads)
        self.depth_head = DPT(token_dim, features, out_channels, 2, patch_size, rectified_skip=True)

    def decode(self, tokens: Tokens, chunk: int | None, cameras: Cameras | None = None) -> Geometry:
        """See :meth:`Backend.decode`; the depth head runs on at most ``chunk`` views at a time."""
        return decode_geometry(self.depth_head, tokens, cameras or self.decode_cameras(tokens), chunk)

    def decode_cameras(self, tokens: Tokens) -> Cameras:
        """See :meth:`Backend.decode_cameras`."""
        with full_precision(tokens.camera):
            world_to_camera, intrinsics = decode_pose(self.camera_head(tokens.camera), tokens.size)
        return Cameras(world_to_camera, intrinsics, tokens.size)


class _VGGTNetwork(VGGTDecoder):
    """Aggregator (images to tokens) and decoder; names and shapes as published."""

    def __init__(
        self, aggregator: _Aggregator, features: int, out_channels: Sequence[int], camera_depth: int, camera_heads: int
    ) -> None:
        token_dim = 2 * aggregator.camera_token.shape[-1]
        super().__init__(token_dim, features, out_channels, aggregator.patch_size, camera_depth, camera_heads)
        self.aggregator = aggregator


class VGGTBackend(NetworkBackend):
    """VGGT (Wang et al., 2025): relative geometry in the frame of the first view. Ignores hints.

    For the arguments see :class:`NetworkBackend`; tokens have 2C channels.
    """

    camera_name = "camera_head"
    encoder_name = "aggregator"
    network: _VGGTNetwork

    def __init__(
        self,
        name: str = "vggt_1b",
        pretrained: bool = True,
        revision: str | None = None,
        path: str | None = None,
        seed: int = 0,
        head_chunk: int | None = 8,
        freeze: bool = True,
        **shape: Any,
    ) -> None:
        net = network_named(name, shape)

        def make() -> _VGGTNetwork:
            aggregator = _Aggregator(
                net.dim, net.depth, net.encoder_depth, net.num_heads, net.image_size, net.patch_size
            )
            network = _VGGTNetwork(aggregator, net.features, net.out_channels, net.camera_depth, net.camera_heads)
            # iterations add up to about the identity pose and fields of view of 1 rad
            predict(network.camera_head.pose_branch.fc2, [value / _ITERATIONS for value in (0, 0, 0, 0, 0, 0, 1, 1, 1)])
            return network

        weights = Weights(name, net.licence, pretrained, net.repo, revision, path, seed, ignorable=_IGNORABLE)
        super().__init__(make, weights, net.patch_size, 2 * net.dim, net.taps, head_chunk, freeze)

    def encode_checked(self, images: Tensor, hints: Hints | None) -> Tokens:
        """See :meth:`NetworkBackend.encode_checked`."""
        with half_precision_on_gpu(images):
            patch, camera = self.network.aggregator(images, self.taps)
        return self.as_tokens(images, patch, camera)
