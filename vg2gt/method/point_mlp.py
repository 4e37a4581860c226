"""PointMLP over windows of serialised voxels, linear in the number of voxels (paper, eqn pointmlp)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

from vg2gt.geometry.precision import Float32Linear
from vg2gt.method.grid import scene_counts
from vg2gt.method.serialization import Order, Windows, make_windows, relative_grid, serial_keys

_STAGE_ORDERS: tuple[Order, ...] = ("hilbert", "hilbert-trans", "z", "z-trans")


class _ResidualPointBlock(nn.Module):
    """``x + W2 relu(W1 LN(x))`` on every row."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(channels)
        self.fc1 = nn.Linear(channels, channels)
        self.fc2 = nn.Linear(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        """Maps ``[..., C]`` to ``[..., C]``."""
        return x + self.fc2(self.fc1(self.norm(x)).relu_())


class GeometricStage(nn.Module):
    """One stage: geometric affine, residual MLP, max over the window, residual MLP, residual update.

    The affine ``alpha (x - m) / s + beta`` of features and positions (m is a window's mean, s one standard deviation
    per scene) enters a linear layer together with the features themselves: ``W1 [affine] + W2 x``. Both are linear, so
    they are applied as ``(W1 alpha / s + W2) (x - m)`` plus constants per window, such as ``W2 m``.

    Args:
        channels: feature width C.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.alpha = nn.Parameter(torch.ones(channels + 3))
        self.beta = nn.Parameter(torch.zeros(channels + 3))
        self.inner = Float32Linear(2 * channels + 3, channels)
        self.before = _ResidualPointBlock(channels)
        self.after = _ResidualPointBlock(channels)
        self.out = nn.Linear(2 * channels, channels)
        self.gamma = nn.Parameter(torch.ones(channels))

    def forward(self, features: Tensor, positions: Tensor, windows: Windows) -> Tensor:
        """Updates ``[M, C]`` features of voxels at ``[M, 3]`` positions (voxel units)."""
        updates = []
        for group in windows.groups:
            rows = group.rows.flatten()
            local = features.index_select(0, rows).unflatten(0, group.rows.shape).split(group.counts)
            place = positions.index_select(0, rows).unflatten(0, group.rows.shape).split(group.counts)
            first = [self._first_layer(*scene) for scene in zip(local, place, strict=True)]
            hidden = self.before(first[0] if len(first) == 1 else torch.cat(first))
            context = self.after(hidden.amax(1))
            # W_o [h | g], where g is the same for all voxels of a window
            weight_hidden, weight_context = self.out.weight.chunk(2, 1)
            update = F.linear(hidden, weight_hidden, self.out.bias) + F.linear(context, weight_context)[:, None]
            updates.append(update.flatten(0, 1))
        update = updates[0] if len(updates) == 1 else torch.cat(updates)
        return torch.addcmul(features, self.gamma, update.index_select(0, windows.owner))

    def _first_layer(self, local: Tensor, place: Tensor) -> Tensor:
        """Affine and linear layer of a scene's windows ``[W, K, C]`` and ``[W, K, 3]``."""
        channels = local.shape[-1]
        of_affine, of_place, of_local = self.inner.weight.split((channels, 3, channels), 1)
        mean = local.mean(1)  # [W, C]
        local, place = local - mean[:, None], place.to(local.dtype)
        place = place - place.mean(1, keepdim=True)
        of_affine = of_affine * (self.alpha[:channels] / _root_mean_square(local))
        of_place = of_place * (self.alpha[channels:] / _root_mean_square(place))
        weight = torch.cat((of_affine + of_local, of_place), 1)
        constant = self.inner.bias + self.inner.weight[:, : channels + 3] @ self.beta + F.linear(mean, of_local)
        return F.linear(torch.cat((local, place), -1), weight) + constant[:, None]


def _root_mean_square(deviation: Tensor) -> Tensor:
    square = torch.linalg.vector_norm(deviation).square() / deviation.numel()
    # the inner constant keeps the root differentiable for single voxels
    return (square + 1e-10).sqrt() + 1e-5


class PointMLP(nn.Module):
    """Refines voxel features with their neighbours along space-filling curves.

    The farthest-point sampling and nearest neighbours of the original are quadratic. Here, a local group is a window of
    consecutive voxels along a curve. Stages alternate between curves, and odd stages shift by half a window.

    Args:
        in_channels: channels of the pooled features.
        channels: width C.
        stages: number of stages.
        window: voxels per local group.
        checkpoint: whether to recompute each stage in the backward pass to save memory.
    """

    def __init__(
        self, in_channels: int, channels: int = 128, stages: int = 2, window: int = 32, checkpoint: bool = False
    ) -> None:
        super().__init__()
        self.out_channels = channels
        self.window = window
        self.checkpoint = checkpoint
        self.embed = nn.Sequential(nn.Linear(in_channels, channels), nn.LayerNorm(channels), nn.ReLU())
        self.stages = nn.ModuleList(GeometricStage(channels) for _ in range(stages))

    def forward(self, features: Tensor, grid: Tensor, batch: Tensor, voxel_size: Tensor) -> Tensor:
        """Refines features.

        Args:
            features: ``[M, in_channels]``.
            grid: ``[M, 3]`` int64 cells.
            batch: ``[M]`` scene index, sorted.
            voxel_size: ``[B]`` edge lengths, for error messages.

        Returns:
            ``[M, channels]``.

        Raises:
            ValueError: if a scene spans too many voxels to be serialised.
        """
        features = self.embed(features)
        if not len(features):
            # no voxels, but all parameters must be in the graph: other ranks would wait for their gradients
            return features + 0 * sum(parameter.sum() for parameter in self.stages.parameters())
        local = relative_grid(grid, batch, len(voxel_size))
        positions = local.float()
        for stage, windows in zip(self.stages, self._windows(local, batch, voxel_size), strict=True):
            if self.checkpoint and torch.is_grad_enabled():
                features = checkpoint(stage, features, positions, windows, use_reentrant=False)
            else:
                features = stage(features, positions, windows)
        return features

    def _windows(self, grid: Tensor, batch: Tensor, voxel_size: Tensor) -> list[Windows]:
        orders = _STAGE_ORDERS[: len(self.stages)]
        *counts, last = torch.cat((scene_counts(batch, len(voxel_size)), grid.max()[None])).tolist()
        curves = [torch.argsort(key) for key in serial_keys(grid, batch, voxel_size, orders, extent=last + 1)]
        windows = [make_windows(counts, self.window, grid.device, shift) for shift in (0, self.window // 2)]
        return [windows[i % 2].along(curves[i % len(curves)]) for i in range(len(self.stages))]
