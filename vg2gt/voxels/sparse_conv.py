"""Submanifold sparse convolution in plain torch: outputs exist exactly where inputs do."""

from __future__ import annotations

import itertools
from typing import Any

import torch
from torch import Tensor, nn

from vg2gt.voxels.grid import mixed_radix_keys

Pairs = list[tuple[Tensor, Tensor]]
CHUNK = 1 << 22  # cells times offsets looked up at once


def neighbor_pairs(grid: Tensor, batch: Tensor, kernel_size: int) -> Pairs:
    """Pairs of occupied cells at each offset of the first half of a cubic kernel; the other half mirrors them.

    Args:
        grid: ``[M, 3]`` int64 distinct cells.
        batch: ``[M]`` scene index.
        kernel_size: odd edge length of the kernel.

    Returns:
        For offset number t (x slowest) of the ``kernel_size^3 // 2`` before the centre, the rows ``(i, j)`` with
        ``grid[j] = grid[i] + offset``.
    """
    radius = kernel_size // 2
    keys, steps = mixed_radix_keys(grid, batch, margin=radius)
    keys, order = torch.sort(keys)
    offsets = itertools.islice(itertools.product(range(-radius, radius + 1), repeat=3), kernel_size**3 // 2)
    moves = keys.new_tensor([sum(o * s for o, s in zip(offset, steps, strict=True)) for offset in offsets])
    counts, rows, neighbors = [], [], []
    # many offsets at a time: how many pairs there are is a shape, for which the host waits
    for some in moves.split(max(1, CHUNK // max(1, len(keys)))):
        wanted = keys + some[:, None]
        place = torch.searchsorted(keys, wanted).clamp_(max=len(keys) - 1)
        found = keys[place] == wanted
        offset, row = found.nonzero().unbind(-1)
        counts.append(found.sum(-1))
        rows.append(order[row])
        neighbors.append(order[place[offset, row]])
    lengths = torch.cat(counts).tolist()
    return list(zip(torch.cat(rows).split(lengths), torch.cat(neighbors).split(lengths), strict=True))


class _SubmanifoldConvolution(torch.autograd.Function):
    """Gathers, multiplies and adds one kernel offset after the other; the backward pass gathers again."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, weight: Tensor, pairs: Pairs) -> Tensor:
        """``[M, out]`` of ``features [M, in]`` and ``weight [out, k, k, k, in]``, summed over neighbouring voxels."""
        taps = weight.flatten(1, 3).unbind(1)  # k^3 times [out, in]
        out = features @ taps[len(pairs)].t()
        for t, (i, j) in enumerate(pairs):
            out.index_add_(0, i, features.index_select(0, j) @ taps[t].t())
            out.index_add_(0, j, features.index_select(0, i) @ taps[-1 - t].t())
        ctx.save_for_backward(features, weight)
        ctx.pairs = pairs
        return out

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, Tensor, None]:  # pyright: ignore
        """Gradients of the features and the weight; the products of the forward pass are made anew."""
        (grad,) = grad_outputs
        features, weight = ctx.saved_tensors
        pairs: Pairs = ctx.pairs
        taps = weight.flatten(1, 3).unbind(1)  # k^3 times [out, in]
        grad_weight = torch.empty_like(weight)
        grad_taps = grad_weight.flatten(1, 3).unbind(1)
        grad_features = grad @ taps[len(pairs)]
        grad_taps[len(pairs)].copy_(grad.t() @ features)
        for t, (i, j) in enumerate(pairs):
            for tap, target, source in ((t, i, j), (-1 - t, j, i)):
                grad_rows = grad.index_select(0, target)
                grad_features.index_add_(0, source, grad_rows @ taps[tap])
                grad_taps[tap].copy_(grad_rows.t() @ features.index_select(0, source))
        return grad_features, grad_weight, None


class SubmanifoldConv3d(nn.Module):
    """Convolution over occupied voxels; equals a dense ``conv3d`` with zeros elsewhere, read at the occupied cells.

    Args:
        in_channels: input channels.
        out_channels: output channels.
        kernel_size: odd edge length of the cubic kernel.
        bias: adds a bias.

    Attributes:
        weight: ``[out, k, k, k, in]``, axes x, y, z.
    """

    def __init__(self, in_channels: int, out_channels: int, kernel_size: int, bias: bool = True) -> None:
        super().__init__()
        self.kernel_size = kernel_size
        bound = (in_channels * kernel_size**3) ** -0.5
        shape = (out_channels, kernel_size, kernel_size, kernel_size, in_channels)
        self.weight = nn.Parameter(torch.empty(shape).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.zeros(out_channels)) if bias else None

    def forward(self, features: Tensor, pairs: Pairs) -> Tensor:
        """Convolves ``[M, in]`` features.

        Args:
            features: ``[M, in]``.
            pairs: :func:`neighbor_pairs` of this kernel size.

        Returns:
            ``[M, out]``.
        """
        out: Tensor = _SubmanifoldConvolution.apply(features, self.weight, pairs)  # pyright: ignore
        return out if self.bias is None else out + self.bias
