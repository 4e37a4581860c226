"""Backbone of Depth Anything 3: a ViT whose later blocks alternate between single views and all views.

Module names in this folder follow the published weight files.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from backends.positions import Rotary, grid_positions, remembered, resize_position_embedding, rotary_2d
from backends.vit import FeedForward, PatchEmbed, ViTBlock, first_and_others

ReferenceView = Literal["first", "saddle_balanced"]
_MIN_VIEWS_TO_CHOOSE = 3


class Backbone(nn.Module):
    """ViT whose class token is replaced by a camera token at the first multi-view block.

    Args:
        dim: channels C of the tokens.
        depth: number of blocks.
        num_heads: attention heads.
        ffn: feed-forward layer.
        multiview_from: first multi-view block. From it on, blocks use rotary position embedding and normalise queries
            and keys, and odd blocks attend over all views. None makes a single-view network.
        image_size: native image edge, which determines the size of the position embedding.
        patch_size: edge of a patch in pixels.
    """

    def __init__(
        self,
        dim: int,
        depth: int,
        num_heads: int,
        ffn: FeedForward,
        multiview_from: int | None,
        image_size: int,
        patch_size: int,
    ) -> None:
        super().__init__()
        self.patch_size = patch_size
        self.head_dim = dim // num_heads
        self.multiview_from = depth if multiview_from is None else multiview_from
        self.cls_token = nn.Parameter(torch.zeros(1, 1, dim).normal_(std=0.02))
        if multiview_from is not None:
            self.camera_token = nn.Parameter(torch.zeros(1, 2, dim).normal_(std=0.02))  # reference view, other views
        self.pos_embed = nn.Parameter(torch.zeros(1, (image_size // patch_size) ** 2 + 1, dim).normal_(std=0.02))
        self.patch_embed = PatchEmbed(patch_size, dim)
        self.blocks = nn.ModuleList(
            ViTBlock(dim, num_heads, qk_norm=index >= self.multiview_from, ffn=ffn) for index in range(depth)
        )
        self.norm = nn.LayerNorm(dim, eps=1e-5)

    def forward(
        self,
        images: Tensor,
        taps: Sequence[int],
        reference: ReferenceView = "first",
        camera_tokens: Tensor | None = None,
    ) -> tuple[list[Tensor], Tensor]:
        """Runs the blocks.

        Args:
            images: normalised images ``[B, V, 3, H, W]``.
            taps: indices of the tapped blocks.
            reference: strategy to choose the view that defines the predicted world frame; the first view is used for
                fewer than three views, or if camera tokens are given.
            camera_tokens: ``[B, V, C]`` from the camera encoder, in place of the learned ones.

        Returns:
            Patch tokens ``[B, V, P, D]`` of every tap, and the camera token ``[B, V, D]`` of the last tap. Single-view
            networks have D = C. Multi-view networks have D = 2C: the output of the last within-view block, concatenated
            with the output of the tapped block (patch tokens of the latter are normalised).
        """
        batch, views = images.shape[:2]
        grid = (images.shape[-2] // self.patch_size, images.shape[-1] // self.patch_size)
        x = self._embed(images.flatten(0, 1), grid).unflatten(0, (batch, views))
        local_rotary, global_rotary = _rotary_tables(grid, views, self.head_dim, x.device)
        choose = camera_tokens is None and reference != "first"
        order: Tensor | None = None
        local, tapped, camera = x, [], x[:, :, 0]
        for index, block in enumerate(self.blocks):
            # move the reference view to the front, just before the multi-view blocks
            if choose and index == self.multiview_from - 1:
                order = _reference_first(_select_reference(x[:, :, 0]), views)
                x = _take_views(x, order)
                local = _take_views(local, order)
            if index == self.multiview_from:
                learned = first_and_others(self.camera_token, views).expand(batch, -1, -1)
                token = learned if camera_tokens is None else camera_tokens  # [B, V, C]
                x = torch.cat((token[:, :, None].to(x.dtype), x[:, :, 1:]), 2)
            # attend over all views: [B, V N, C], or within each: [B V, N, C]
            if index >= self.multiview_from and index % 2 == 1:
                x = block(x.flatten(1, 2), global_rotary).unflatten(1, (views, -1))
            else:
                rotary = local_rotary if index >= self.multiview_from else None
                local = x = block(x.flatten(0, 1), rotary).unflatten(0, (batch, views))
            if index in taps:
                patch, camera = self._tap(local, x)
                if order is not None:
                    inverse = order.argsort(1)
                    patch, camera = _take_views(patch, inverse), _take_views(camera, inverse)
                tapped.append(patch)
        return tapped, camera

    def _embed(self, images: Tensor, grid: tuple[int, int]) -> Tensor:
        patches = self.patch_embed(images) + resize_position_embedding(self.pos_embed[0, 1:], grid, "scale")
        first = (self.cls_token + self.pos_embed[:, :1]).expand(images.shape[0], -1, -1)
        return torch.cat((first.to(patches.dtype), patches), 1)

    def _tap(self, local: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        if self.multiview_from == len(self.blocks):
            return self.norm(x[:, :, 1:]), x[:, :, 0]
        patch = torch.cat((local[:, :, 1:], self.norm(x[:, :, 1:]).to(local.dtype)), -1)
        return patch, torch.cat((local[:, :, 0], x[:, :, 0]), -1)


@remembered
def _rotary_tables(grid: tuple[int, int], views: int, head_dim: int, device: torch.device) -> tuple[Rotary, Rotary]:
    """Tables within views (patch positions from 1) and across views (all patches at (1, 1)); class token at 0."""
    patches = grid_positions(*grid, device) + 1
    special = patches.new_zeros(1, 2)
    within = rotary_2d(torch.cat((special, patches)), head_dim)
    cos, sin = rotary_2d(torch.cat((special, torch.ones_like(patches))), head_dim)
    return within, (cos.repeat(views, 1), sin.repeat(views, 1))


def _select_reference(tokens: Tensor) -> Tensor:
    """Chooses the reference view of each scene as ``saddle_balanced`` does.

    Scales three measures to [0, 1] over the views, and chooses the view closest to 0.5 in all of them: mean cosine
    similarity to the other views, token norm, and variance of the normalised token.

    Args:
        tokens: class tokens ``[B, V, C]``.

    Returns:
        Indices ``[B]``, int64; 0 for fewer than three views.
    """
    tokens = tokens.float()
    length = tokens.norm(dim=-1)
    unit = tokens / length[..., None]
    similarity = ((unit @ unit.mT).sum(-1) - 1) / (tokens.shape[1] - 1)
    measures = torch.stack((similarity, length, unit.var(-1)))
    low, high = measures.amin(-1, keepdim=True), measures.amax(-1, keepdim=True)
    scaled = (measures - low) / (high - low + 1e-8)
    # Compare as a tensor: a Python comparison would fix the number of views in an export.
    enough = torch.full((), tokens.shape[1], device=tokens.device) >= _MIN_VIEWS_TO_CHOOSE
    return torch.where(enough, (scaled - 0.5).abs().sum(0).argmin(-1), 0)


def _reference_first(reference: Tensor, views: int) -> Tensor:
    """Returns the order ``[B, V]`` of the views that moves the reference ``[B]`` to the front."""
    index = torch.arange(views, device=reference.device)
    chosen = reference[:, None]
    return torch.where(index == 0, chosen, torch.where(index <= chosen, index - 1, index))


def _take_views(x: Tensor, order: Tensor) -> Tensor:
    """Reorders the view axis of ``[B, V, ...]`` by ``[B, V]``."""
    return x[torch.arange(x.shape[0], device=x.device)[:, None], order]
