"""Transformer layers shared by the frozen networks: attention, feed-forward layers, blocks."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from backends.positions import Rotary, rotate

FeedForward = Literal["mlp", "swiglu"]


class Attention(nn.Module):
    """Multi-head self-attention, optionally with normalised queries and keys and rotary position embedding."""

    def __init__(self, dim: int, num_heads: int, qk_norm: bool = False) -> None:
        super().__init__()
        self.num_heads = num_heads
        head_dim = dim // num_heads
        self.qkv = nn.Linear(dim, 3 * dim)
        self.q_norm = nn.LayerNorm(head_dim, eps=1e-5) if qk_norm else nn.Identity()
        self.k_norm = nn.LayerNorm(head_dim, eps=1e-5) if qk_norm else nn.Identity()
        self.proj = nn.Linear(dim, dim)

    def forward(self, x: Tensor, rotary: Rotary | None = None) -> Tensor:
        """Attends over the N axis of ``x [B, N, C]``; ``rotary`` tables broadcast to ``[B, heads, N, head_dim]``."""
        query, key, value = self.qkv(x).unflatten(-1, (3, self.num_heads, -1)).permute(2, 0, 3, 1, 4).unbind(0)
        query, key = self.q_norm(query), self.k_norm(key)
        if rotary is not None:
            query, key = rotate(torch.stack((query, key)), rotary)
        # Under autocast, normalised queries and keys may stay float32, but the three dtypes must match.
        out = F.scaled_dot_product_attention(query.to(value.dtype), key.to(value.dtype), value)
        return self.proj(out.transpose(1, 2).flatten(2))


class ViTMLP(nn.Module):
    """Two linear layers with GELU in between."""

    def __init__(self, dim: int, hidden: int, out: int | None = None) -> None:
        super().__init__()
        self.fc1 = nn.Linear(dim, hidden)
        self.fc2 = nn.Linear(hidden, out or dim)

    def forward(self, x: Tensor) -> Tensor:
        """Maps ``[..., dim]`` to ``[..., out]``."""
        return self.fc2(F.gelu(self.fc1(x)))


class _SwiGLU(nn.Module):
    """Gated feed-forward layer; its hidden width is two thirds of ``hidden``, rounded up to a multiple of 8."""

    def __init__(self, dim: int, hidden: int) -> None:
        super().__init__()
        hidden = (hidden * 2 // 3 + 7) // 8 * 8
        self.w12 = nn.Linear(dim, 2 * hidden)
        self.w3 = nn.Linear(hidden, dim)

    def forward(self, x: Tensor) -> Tensor:
        """Maps ``[..., dim]`` to ``[..., dim]``."""
        gate, value = self.w12(x).chunk(2, -1)
        return self.w3(F.silu(gate) * value)


class _LayerScale(nn.Module):
    """Learned scale per channel."""

    def __init__(self, dim: int, value: float) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.full((dim,), value))

    def forward(self, x: Tensor) -> Tensor:
        """Scales ``[..., dim]``."""
        return x * self.gamma


class ViTBlock(nn.Module):
    """Pre-norm transformer block: attention and feed-forward layer, each with LayerScale and a residual connection.

    Args:
        dim: channels of the tokens.
        num_heads: attention heads.
        qk_norm: whether to normalise queries and keys, with eps 1e-5.
        ffn: feed-forward layer, with hidden width ``4 * dim`` (two thirds of that for SwiGLU).
        layer_scale: initial value of LayerScale.
        eps: eps of the two block norms.

    Raises:
        ValueError: if ``ffn`` is unknown.
    """

    def __init__(
        self,
        dim: int,
        num_heads: int,
        qk_norm: bool = False,
        ffn: FeedForward = "mlp",
        layer_scale: float = 1.0,
        eps: float = 1e-6,
    ) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(dim, eps=eps)
        self.attn = Attention(dim, num_heads, qk_norm)
        self.ls1 = _LayerScale(dim, layer_scale)
        self.norm2 = nn.LayerNorm(dim, eps=eps)
        if ffn not in get_args(FeedForward):
            raise ValueError(f"backend.ffn is {ffn!r}; choose one of {', '.join(get_args(FeedForward))}")
        self.mlp = _SwiGLU(dim, 4 * dim) if ffn == "swiglu" else ViTMLP(dim, 4 * dim)
        self.ls2 = _LayerScale(dim, layer_scale)

    def forward(self, x: Tensor, rotary: Rotary | None = None) -> Tensor:
        """Maps ``[B, N, dim]`` to ``[B, N, dim]``."""
        x = x + self.ls1(self.attn(self.norm1(x), rotary))
        return x + self.ls2(self.mlp(self.norm2(x)))


class PatchEmbed(nn.Module):
    """Linear embedding of square patches."""

    def __init__(self, patch_size: int, dim: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, dim, patch_size, patch_size)

    def forward(self, images: Tensor) -> Tensor:
        """Maps ``[N, 3, H, W]`` to ``[N, P, dim]``, row major."""
        return self.proj(images).flatten(2).transpose(1, 2)


def first_and_others(tokens: Tensor, views: int) -> Tensor:
    """Expands two learned tokens ``[1, 2, ...]``, for the first and for all other views, to ``[1, V, ...]``."""
    return tokens[:, (torch.arange(views, device=tokens.device) > 0).long()]
