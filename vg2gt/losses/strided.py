"""Neighbouring pixels of maps at several strides, read and summed together: a GPU needs few operations for all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

Group = tuple[tuple[slice, slice], ...]
"""Rows and columns of K neighbours: slices of equal length."""


@dataclass(frozen=True, eq=False)
class Neighbors:
    """N groups of K neighbouring pixels, sorted by stride.

    Attributes:
        groups: the slices that hold them, in order.
        rows: ``[K, N]`` rows of the pixels.
        columns: ``[K, N]`` columns of the pixels.
        stride: ``[N]`` stride of each group, float32.
        lengths: groups of each stride.
    """

    groups: list[Group]
    rows: Tensor
    columns: Tensor
    stride: Tensor
    lengths: list[int]

    def read(self, maps: Tensor) -> Tensor:
        """Reads maps ``[..., H, W]`` as ``[..., K, N]``."""
        return _Read.apply(maps, self)  # pyright: ignore

    def sums(self, values: Tensor) -> Tensor:
        """Sums ``[..., N]`` over the groups of each stride: ``[..., strides]``."""
        return torch.stack([part.sum(-1) for part in values.split(self.lengths, -1)], -1)


def by_slices(device: torch.device) -> bool:
    """Whether this device reads slices one by one, which is cheaper on a CPU than indexing."""
    return device.type == "cpu"


class _Read(torch.autograd.Function):
    """Indexing whose backward pass adds slices, in a fixed order."""

    @staticmethod
    def forward(ctx: Any, maps: Tensor, neighbors: Neighbors) -> Tensor:
        """Returns ``[..., K, N]``."""
        ctx.shape, ctx.groups = maps.shape, neighbors.groups
        if not by_slices(maps.device):
            return maps[..., neighbors.rows, neighbors.columns]
        parts = [torch.stack([maps[..., rows, columns] for rows, columns in group], -3) for group in neighbors.groups]
        return torch.cat([part.flatten(-2) for part in parts], -1)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None]:  # pyright: ignore
        """Returns the gradient of the maps."""
        grad, begin = grad_outputs[0].new_zeros(ctx.shape), 0
        for group in ctx.groups:
            targets = [grad[..., rows, columns] for rows, columns in group]
            size = targets[0].shape[-2:]
            parts = grad_outputs[0].narrow(-1, begin, size.numel()).unflatten(-1, size).unbind(-3)
            for target, part in zip(targets, parts, strict=True):
                target.add_(part)
            begin += size.numel()
        return grad, None


def _pairs(stride: int) -> list[Group]:
    every, first, second = slice(None, None, stride), slice(None, -stride, stride), slice(stride, None, stride)
    return [((every, first), (every, second)), ((first, every), (second, every))]


def _squares(stride: int) -> list[Group]:
    first, second = slice(None, -stride, stride), slice(stride, None, stride)
    return [((first, first), (first, second), (second, first), (second, second))]


def neighbor_pairs(size: tuple[int, int], strides: Sequence[int], device: torch.device) -> Neighbors:
    """Returns pixels and their neighbours to the right, then below, of every ``stride``-th row and column (K = 2)."""
    return _neighbors(_pairs, size, tuple(strides), device)


def pixel_squares(size: tuple[int, int], strides: Sequence[int], device: torch.device) -> Neighbors:
    """Returns squares of 2x2 neighbours in every ``stride``-th row and column, row by row (K = 4)."""
    return _neighbors(_squares, size, tuple(strides), device)


@lru_cache(maxsize=16)
@torch.inference_mode(False)
def _neighbors(
    grouped: Callable[[int], list[Group]], size: tuple[int, int], strides: tuple[int, ...], device: torch.device
) -> Neighbors:
    axes = torch.meshgrid(*(torch.arange(length, device=device) for length in size), indexing="ij")
    groups = [grouped(stride) for stride in strides]
    flat = [group for each in groups for group in each]
    rows, columns = (
        torch.cat([torch.stack([axis[part].flatten() for part in group]) for group in flat], 1) for axis in axes
    )
    lengths = [sum(axes[0][group[0]].numel() for group in each) for each in groups]
    stride = torch.tensor(strides, dtype=torch.float32).repeat_interleave(torch.tensor(lengths)).to(device)
    return Neighbors(flat, rows, columns, stride, lengths)
