"""Point Transformer V3 in plain torch (Wu et al., CVPR 2024), for packed voxels.

Parameter names match the official implementation, so that its state dicts load.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from vg2gt.method.serialization import ORDERS, Windows, make_windows, relative_grid, serial_keys
from vg2gt.method.sparse_conv import Cells, NeighborTable, Pairs, SubmanifoldConv3d, neighbors
from vg2gt.types import check_choice

Norm = Literal["layer", "batch"]


@dataclass(eq=False)
class Level:
    """Voxels of one resolution without features: their curves, windows and neighbours, each computed once.

    Args:
        grid: ``[M, 3]`` int64 cells.
        batch: ``[M]`` scene index, sorted.
        counts: number of voxels per scene.
        keys: ``[orders, M]`` sort keys of every serialisation order.
        generator: shuffles the orders, so that blocks use them in random sequence; None keeps the sequence.
        parent_of: ``[M]`` parent of each voxel in the next level; at the last level, the voxel itself.
        order: ``[M]`` voxels sorted by parent; None if they are already sorted.
    """

    grid: Tensor
    batch: Tensor
    counts: list[int]
    keys: Tensor
    generator: torch.Generator | None
    parent_of: Tensor
    order: Tensor | None = None

    def __post_init__(self) -> None:
        count = len(self.keys)
        drawn = torch.randperm(count, generator=self.generator).tolist() if self.generator else list(range(count))
        self.sequence: list[int] = drawn
        self._windows: dict[tuple[int, int], Windows] = {}
        self._positions: dict[int, Windows] = {}  # of the same windows on any curve, by length
        self.pairs: dict[int, Pairs | NeighborTable] = {}

    def windows(self, order: int, length: int) -> Windows:
        """Returns the attention windows along the curve of block number ``order``."""
        which = self.sequence[order % len(self.sequence)]
        if (which, length) not in self._windows:
            if length not in self._positions:
                self._positions[length] = make_windows(self.counts, length, self.grid.device)
            self._windows[which, length] = self._positions[length].along(torch.argsort(self.keys[which]))
        return self._windows[which, length]


def _make_levels(
    grid: Tensor,
    batch: Tensor,
    scenes: int,
    keys: Tensor,
    extent: Sequence[int],
    kernels: Sequence[Sequence[int]],
    generator: torch.Generator | None,
) -> list[Level]:
    """Builds all levels of a network; synchronises with a GPU twice, whatever their number.

    Args:
        grid: ``[M, 3]`` int64 cells relative to their scene's smallest.
        batch: ``[M]`` scene index, sorted.
        scenes: B.
        keys: ``[orders, M]`` sort keys at the finest level.
        extent: cells along each axis.
        kernels: kernel edge lengths of the convolutions at each level, finest first.
        generator: shuffles every level's orders.
    """
    depth, device = len(kernels), grid.device
    curve, order = torch.sort(keys[0])
    codes = curve >> 3 * torch.arange(depth, device=device)[:, None]  # [S, M] cell of every voxel at S levels
    begins = F.pad(codes[:, 1:] != codes[:, :-1], (1, 0), value=True)
    before = F.pad(begins.cumsum(1), (1, 0))  # [S, M + 1] number of cells before each voxel
    bounds = torch.searchsorted(batch, torch.arange(scenes + 1, device=device))
    counts: list[list[int]] = before[:, bounds].diff().tolist()
    in_cell = before[:, 1:] - 1  # [S, M] row of every voxel's cell
    levels = []
    for s in range(depth):
        below = in_cell[min(s + 1, depth - 1)]
        if s:  # one voxel per cell; cells are sorted along the curve
            place = torch.searchsorted(in_cell[s], torch.arange(sum(counts[s]), device=device))
            first = order[place]
            rows = (grid[first] >> s, batch[first], counts[s], keys[:, first] >> 3 * s)
            levels.append(Level(*rows, generator, below[place]))
        else:
            parent_of = torch.empty_like(order).scatter_(0, order, below)
            levels.append(Level(grid, batch, counts[s], keys, generator, parent_of, order))
    wanted = [(level, size) for level, sizes in zip(levels, kernels, strict=True) for size in sizes]
    spans = {level: [*((cells - 1 >> s) + 1 for cells in extent), scenes] for s, level in enumerate(levels)}
    found = neighbors([Cells(level.grid, level.batch, size, spans[level]) for level, size in wanted])
    for (level, size), pairs in zip(wanted, found, strict=True):
        level.pairs[size] = pairs
    return levels


class SerializedAttention(nn.Module):
    """Multi-head attention within windows of consecutive voxels.

    Args:
        channels: width.
        heads: number of heads.
        window: voxels per window.
        order: index of the curve in the level's sequence.
    """

    def __init__(self, channels: int, heads: int, window: int, order: int) -> None:
        super().__init__()
        self.heads = heads
        self.window = window
        self.order = order
        self.qkv = nn.Linear(channels, 3 * channels)
        self.proj = nn.Linear(channels, channels)

    def forward(self, features: Tensor, level: Level) -> Tensor:
        """Maps ``[M, C]`` to ``[M, C]``."""
        windows = level.windows(self.order, self.window)
        qkv = self.qkv(features)  # [M, 3 C]
        parts = []
        for group in windows.groups:
            rows = qkv.index_select(0, group.rows.flatten())  # [W K, 3 C]
            rows = rows.view(*group.rows.shape, 3, self.heads, -1)  # [W, K, 3, heads, C / heads]
            query, key, value = rows.permute(2, 0, 3, 1, 4)  # [W, heads, K, C / heads] each
            attended = F.scaled_dot_product_attention(query, key, value)
            parts.append(attended.transpose(1, 2).flatten(2).flatten(0, 1))  # [W K, C]
        attended = parts[0] if len(parts) == 1 else torch.cat(parts)
        return self.proj(attended.index_select(0, windows.owner))


class MLP(nn.Module):
    """Two linear layers with a GELU in between."""

    def __init__(self, channels: int, ratio: float) -> None:
        super().__init__()
        self.fc1 = nn.Linear(channels, int(channels * ratio))
        self.fc2 = nn.Linear(int(channels * ratio), channels)

    def forward(self, x: Tensor) -> Tensor:
        """Maps ``[M, C]`` to ``[M, C]``."""
        return self.fc2(F.gelu(self.fc1(x)))


class _Residual(torch.autograd.Function):
    """``features + change * kept`` in one operation, forward and backward, whatever the dtypes."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, change: Tensor, kept: Tensor) -> Tensor:
        """Returns ``[M, C]`` for ``kept [M, 1]``, which has no gradient."""
        ctx.save_for_backward(kept)
        ctx.dtype = change.dtype
        return torch.addcmul(features, change, kept, out=torch.empty_like(features))  # autocast would copy the change

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, Tensor, None]:  # pyright: ignore
        """Returns the gradients of the features and the change."""
        (kept,) = ctx.saved_tensors
        of_change = torch.empty_like(grad_outputs[0], dtype=ctx.dtype)
        return grad_outputs[0], torch.mul(grad_outputs[0], kept, out=of_change), None


class _PTv3Block(nn.Module):
    """Conditional positional encoding by sparse convolution (xCPE), attention and MLP, each residual.

    Args:
        channels: width.
        heads: attention heads.
        window: voxels per attention window.
        order: index of the curve.
        mlp_ratio: hidden width of the MLP relative to ``channels``.
        drop_path: probability that a voxel skips a residual branch while training.
    """

    def __init__(self, channels: int, heads: int, window: int, order: int, mlp_ratio: float, drop_path: float) -> None:
        super().__init__()
        self.drop_path = drop_path
        self.cpe = nn.ModuleList(
            [SubmanifoldConv3d(channels, channels, 3), nn.Linear(channels, channels), nn.LayerNorm(channels)]
        )
        self.norm1 = nn.ModuleList([nn.LayerNorm(channels)])
        self.attn = SerializedAttention(channels, heads, window, order)
        self.norm2 = nn.ModuleList([nn.LayerNorm(channels)])
        self.mlp = nn.ModuleList([MLP(channels, mlp_ratio)])

    def forward(self, features: Tensor, level: Level, conv_input: Tensor | None = None) -> Tensor:
        """Maps ``[M, C]`` to ``[M, C]``; ``conv_input`` replaces the input of the xCPE (legacy)."""
        conv, linear, norm = self.cpe
        x = conv(features if conv_input is None else conv_input, level.pairs[3])
        features = features + norm(linear(x))
        attended = self.attn(self.norm1[0](features), level)
        if not (self.training and self.drop_path):
            features = features + attended
            return features + self.mlp[0](self.norm2[0](features))
        share = 1 - self.drop_path  # of the voxels that keep a branch, which is scaled to the same mean
        kept = torch.empty(2, len(features), 1, device=features.device).bernoulli_(share) / share
        features = _Residual.apply(features, attended, kept[0])  # pyright: ignore
        return _Residual.apply(features, self.mlp[0](self.norm2[0](features)), kept[1])  # pyright: ignore


class _GridPool(nn.Module):
    """Max pooling into cells of twice the size, after a projection."""

    def __init__(self, in_channels: int, out_channels: int, norm: Norm) -> None:
        super().__init__()
        self.proj = nn.Linear(in_channels, out_channels)
        self.norm = nn.ModuleList([_make_norm(norm, out_channels)])

    def forward(self, features: Tensor, level: Level, coarse: Level) -> Tensor:
        """Returns the features ``[M', C']`` of the next level."""
        projected = self.proj(features).to(features.dtype)  # [M, C']
        parent_of = level.parent_of
        if level.order is not None:
            projected, parent_of = projected.index_select(0, level.order), parent_of[level.order]
        bounds = torch.searchsorted(parent_of, torch.arange(len(coarse.grid) + 1, device=parent_of.device))
        pooled = torch.segment_reduce(projected, "max", lengths=bounds.diff(), unsafe=True)  # [M', C']
        return F.gelu(self.norm[0](pooled))


class _GridUnpool(nn.Module):
    """Copies parents' features to their voxels and adds the skip connection, both projected."""

    def __init__(self, in_channels: int, skip_channels: int, out_channels: int, norm: Norm) -> None:
        super().__init__()
        self.proj = nn.ModuleList([nn.Linear(in_channels, out_channels), _make_norm(norm, out_channels)])
        self.proj_skip = nn.ModuleList([nn.Linear(skip_channels, out_channels), _make_norm(norm, out_channels)])

    def forward(self, features: Tensor, skip: Tensor, parent_of: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the sum ``[M, C]`` and the projected skip connection alone ``[M, C]``."""
        up = F.gelu(self.proj[1](self.proj[0](features)))
        skip = F.gelu(self.proj_skip[1](self.proj_skip[0](skip)))
        return skip + up.index_select(0, parent_of), skip


class PTv3(nn.Module):
    """U-shaped transformer over voxels (paper, eqn ptvzengqiang).

    The default widths, depths and heads are those of AMB3R, which the paper uses.

    Args:
        in_channels: width of the input features.
        enc_channels: widths of the encoder stages, finest first; each stage halves the resolution of the previous one.
        enc_depths: number of blocks in the encoder stages.
        enc_heads: attention heads of the encoder stages.
        dec_channels: widths of the decoder stages, finest first, one fewer than the encoder's.
        dec_depths: number of blocks in the decoder stages.
        dec_heads: attention heads of the decoder stages.
        window: voxels per attention window.
        stem_kernel: edge length of the first convolution.
        mlp_ratio: hidden width of the MLPs relative to their input.
        drop_path: largest probability of skipping a residual branch; it grows linearly with depth.
        norm: normalisation in stem, pooling and unpooling; blocks always use layer normalisation.
        legacy: passes only the skip connection to the convolution of each decoder stage's first block, as the official
            code does; needed to reproduce its results.

    Attributes:
        out_channels: width of the result: ``dec_channels[0]``, or ``enc_channels[0]`` with a single stage.
    """

    def __init__(
        self,
        in_channels: int = 1024,
        enc_channels: Sequence[int] = (128, 128, 128, 256, 512),
        enc_depths: Sequence[int] = (2, 2, 2, 6, 2),
        enc_heads: Sequence[int] = (2, 4, 8, 16, 32),
        dec_channels: Sequence[int] = (1024, 256, 128, 256),
        dec_depths: Sequence[int] = (2, 2, 2, 2),
        dec_heads: Sequence[int] = (32, 8, 8, 16),
        window: int = 64,
        stem_kernel: int = 5,
        mlp_ratio: float = 4,
        drop_path: float = 0.3,
        norm: Norm = "layer",
        legacy: bool = False,
    ) -> None:
        super().__init__()
        stages = len(enc_channels)
        lengths = [len(enc_depths), len(enc_heads), *(len(x) + 1 for x in (dec_channels, dec_depths, dec_heads))]
        if any(length != stages for length in lengths):
            raise ValueError(
                f"ptv3: enc_depths and enc_heads must have {stages} entries like enc_channels, and dec_channels, "
                f"dec_depths and dec_heads one fewer; got {len(enc_depths)} and {len(enc_heads)}, and "
                f"{len(dec_channels)}, {len(dec_depths)} and {len(dec_heads)}"
            )
        self.out_channels = dec_channels[0] if stages > 1 else enc_channels[0]
        self.legacy = legacy

        stem = nn.ModuleDict(
            {
                "conv": SubmanifoldConv3d(in_channels, enc_channels[0], stem_kernel, bias=False),
                "norm": _make_norm(norm, enc_channels[0]),
            }
        )
        self.stem_kernel = stem_kernel
        self.embedding = nn.ModuleDict({"stem": stem})

        def blocks(channels: int, heads: int, rates: list[float]) -> dict[str, nn.Module]:
            return {
                f"block{i}": _PTv3Block(channels, heads, window, i % len(ORDERS), mlp_ratio, rate)
                for i, rate in enumerate(rates)
            }

        enc_rates = _ramp(drop_path, enc_depths)
        dec_rates = [rates[::-1] for rates in _ramp(drop_path, dec_depths)]
        self.enc = nn.ModuleDict()
        self.dec = nn.ModuleDict()
        for s in range(stages):
            down = {"down": _GridPool(enc_channels[s - 1], enc_channels[s], norm)} if s else {}
            self.enc[f"enc{s}"] = nn.ModuleDict({**down, **blocks(enc_channels[s], enc_heads[s], enc_rates[s])})
        below = [*dec_channels, enc_channels[-1]]
        for s in reversed(range(stages - 1)):
            up = {"up": _GridUnpool(below[s + 1], enc_channels[s], dec_channels[s], norm)}
            self.dec[f"dec{s}"] = nn.ModuleDict({**up, **blocks(dec_channels[s], dec_heads[s], dec_rates[s])})

    def forward(
        self,
        features: Tensor,
        grid: Tensor,
        batch: Tensor,
        voxel_size: Tensor,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Enhances voxel features.

        Args:
            features: ``[M, in_channels]``, M >= 1.
            grid: ``[M, 3]`` int64 distinct cells.
            batch: ``[M]`` scene index, sorted.
            voxel_size: ``[B]`` edge lengths, for error messages.
            generator: CPU generator that shuffles the sequence of orders at every level while training.

        Returns:
            ``[M, out_channels]``.

        Raises:
            ValueError: if a scene spans too many voxels to be serialised.
        """
        generator = generator if self.training else None
        # S of eqn ptvzengqiang; S^-1 is Windows.owner, which restores the voxels' order after attention
        local = relative_grid(grid, batch, len(voxel_size))
        extent: list[int] = (local.amax(0) + 1).tolist()
        # every pooling removes one bit per axis from the keys
        bits = max(1, len(self.enc) - 1)
        keys = serial_keys(local, batch, voxel_size, ORDERS, bits, max(extent))
        kernels = [{self.stem_kernel, 3}, *[{3}] * (len(self.enc) - 1)]
        levels = _make_levels(local, batch, len(voxel_size), keys, extent, [[*sizes] for sizes in kernels], generator)
        # stem: [M, in_channels] to [M, enc_channels[0]]
        stem, level = self.embedding["stem"], levels[0]
        features = stem["conv"](features, level.pairs[self.stem_kernel])  # pyright: ignore
        features = features.to(torch.promote_types(features.dtype, torch.float32))
        features = F.gelu(stem["norm"](features))  # pyright: ignore
        # encoder: pool from level to level and keep the skip connections
        skips = []
        for stage, level in zip(self.enc.values(), levels, strict=True):
            for name, module in stage.items():  # pyright: ignore
                if name == "down":
                    skips.append((features, levels[len(skips)]))
                    features = module(features, skips[-1][1], level)
                else:
                    features = module(features, level)
        # decoder: unpool back to the finest level, [M, out_channels]
        for stage in self.dec.values():
            skip, level = skips.pop()
            features, skip = stage["up"](features, skip, level.parent_of)  # pyright: ignore
            conv_input = skip if self.legacy else None
            for name, block in stage.items():  # pyright: ignore
                if name != "up":
                    features, conv_input = block(features, level, conv_input), None
        return features


def _ramp(largest: float, depths: Sequence[int]) -> list[list[float]]:
    """Returns rates from 0 to ``largest`` over all blocks, split by stage."""
    step = largest / max(1, sum(depths) - 1)
    starts = itertools.accumulate(depths, initial=0)
    return [[step * (start + i) for i in range(depth)] for start, depth in zip(starts, depths, strict=False)]


def _make_norm(kind: Norm, channels: int) -> nn.Module:
    check_choice("ptv3.norm", kind, Norm)
    return _BatchNorm(channels, eps=1e-3, momentum=0.01) if kind == "batch" else nn.LayerNorm(channels)


class _BatchNorm(nn.BatchNorm1d):
    def forward(self, input: Tensor) -> Tensor:
        """Normalises ``[N, C]``; a single row has no variance and is normalised by the running statistics."""
        if len(input) > 1:
            return super().forward(input)
        return F.batch_norm(input, self.running_mean, self.running_var, self.weight, self.bias, eps=self.eps)
