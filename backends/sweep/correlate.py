"""Similarity of views with their sources at hypothetical depths: torch reference and compiled CPU kernels.

The kernels project, sample and multiply point by point, so they never store a tensor of size planes x channels. Depths
and cameras get no gradient, as planes are hypotheses.
"""

from __future__ import annotations

from copy import copy
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from backends.sweep.views import rays, relative_poses
from vg2gt.kernels.compiled import kernel

GROUPS = 8  # similarities per point: dot products over the channels c with equal c % GROUPS
BEHIND = 1e-3  # a point is not visible in a source below this ratio of its depth there to its depth here


class SourceWarp:
    """Projection of the points of every view into its sources.

    Args:
        world_to_camera: ``[N, 4, 4]``.
        intrinsics: ``[N, 3, 3]``, at the resolution of the feature maps.
        sources: indices of the sources ``[V, n]``.
        size: size of the feature maps ``(h, w)``.
    """

    def __init__(self, world_to_camera: Tensor, intrinsics: Tensor, sources: Tensor, size: tuple[int, int]) -> None:
        poses = relative_poses(world_to_camera, sources)
        camera = intrinsics[sources]
        self.at_infinity = camera @ poses[..., :3, :3] @ rays(intrinsics, size)[:, None]  # [V, n, 3, h w]
        self.parallax = camera @ poses[..., :3, 3:]  # [V, n, 3, 1]
        self.sources = sources
        self.size = size
        self.first = 0

    def select(self, views: slice) -> SourceWarp:
        """Returns the warp of some consecutive views only; their sources may be any views."""
        part = copy(self)
        part.first = views.start
        part.at_infinity, part.parallax = self.at_infinity[views], self.parallax[views]
        part.sources = self.sources[views]
        return part

    def __call__(self, source: int, inverse: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Projects points into source number ``source`` of each view.

        Args:
            source: index into the n sources.
            inverse: inverse depths of the points ``[V, D, h w]``.

        Returns:
            Sampling grid ``[V, D, h w, 2]``, in [-1, 1] inside the source; whether the point is visible there
            ``[V, D, h w]``; and its depth in the source times its inverse depth here ``[V, D, h w]``.
        """
        height, width = self.size
        u, v, z = (
            self.at_infinity[:, source, None, axis] + self.parallax[:, source, None, axis] * inverse
            for axis in range(3)
        )
        safe = z.clamp_min(BEHIND)
        u, v = u / safe, v / safe
        inside = (z > BEHIND) & (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
        grid = torch.stack(((2 * u + 1) / width - 1, (2 * v + 1) / height - 1), -1).clamp(-3, 3)
        return grid, inside, z


def correlate(features: Tensor, inverse: Tensor, warp: SourceWarp) -> tuple[Tensor, Tensor]:
    """Computes the group-wise similarity of every view with its sources.

    Args:
        features: features of all views ``[N, C, h, w]``; C a multiple of ``GROUPS``.
        inverse: inverse depths ``[V, D, h w]`` of the views of ``warp``.
        warp: correspondences of all or some of the views.

    Returns:
        Similarity ``[V, n, D, h w, GROUPS]``, 0 outside the source, and whether points are inside ``[V, n, D, h w]``.
    """
    if features.device.type != "cpu" or features.dtype != torch.float32:
        return correlate_reference(features, inverse, warp)
    return _Correlate.apply(features, inverse, warp)  # type: ignore[return-value]


def correlate_reference(features: Tensor, inverse: Tensor, warp: SourceWarp) -> tuple[Tensor, Tensor]:
    """:func:`correlate` in plain torch, for all devices and dtypes."""
    own = features[warp.first : warp.first + len(warp.sources)]
    here = own.unflatten(1, (-1, GROUPS)).flatten(-2).unsqueeze(3)  # [V, c, G, 1, h w]
    similarities, insides = [], []
    for source in range(warp.sources.shape[1]):
        grid, inside, _ = warp(source, inverse)
        there = features[warp.sources[:, source]]
        sampled = F.grid_sample(there, grid.to(there), padding_mode="border", align_corners=False)  # [V, C, D, h w]
        product = (sampled.unflatten(1, (-1, GROUPS)) * here).sum(1)  # [V, G, D, h w]
        similarities.append(product.permute(0, 2, 3, 1) * inside[..., None])
        insides.append(inside)
    return torch.stack(similarities, 1), torch.stack(insides, 1)


class _Correlate(torch.autograd.Function):
    """The kernels as a differentiable operation; see :func:`correlate` for shapes."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, inverse: Tensor, warp: SourceWarp) -> tuple[Tensor, Tensor]:
        """Returns similarity and whether points are inside."""
        maps = features.permute(0, 2, 3, 1).contiguous()  # [N, h, w, C]
        views, sources = warp.sources.shape
        shape = (views, sources, *inverse.shape[1:])
        similarity = torch.empty(*shape, GROUPS)
        inside = torch.empty(shape, dtype=torch.bool)
        tensors = (maps, warp.sources, warp.at_infinity, warp.parallax, inverse)
        geometry = tuple(tensor.detach().contiguous().numpy() for tensor in tensors)
        _forward(geometry, warp.first, similarity.numpy(), inside.numpy())
        ctx.geometry, ctx.first = geometry, warp.first
        ctx.mark_non_differentiable(inside)
        return similarity, inside

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        """Returns the gradient of the features; depths and cameras get none."""
        maps = ctx.geometry[0]
        gradient = np.zeros_like(maps)
        _backward(ctx.geometry, ctx.first, gradients[0].contiguous().numpy(), gradient)
        return torch.from_numpy(gradient).permute(0, 3, 1, 2), None, None


@kernel(fastmath=True, error_model="numpy", nogil=True, inline="always")
def sample_at(at_infinity, parallax, p, inverse, height, width):
    """Rows, columns and bilinear weights of the four pixels around a point in the source, and whether it is inside."""
    z = at_infinity[2, p] + parallax[2, 0] * inverse
    safe = max(z, np.float32(BEHIND))
    u = (at_infinity[0, p] + parallax[0, 0] * inverse) / safe
    v = (at_infinity[1, p] + parallax[1, 0] * inverse) / safe
    inside = z > BEHIND and u > -0.5 and u < width - 0.5 and v > -0.5 and v < height - 0.5
    u = min(max(u, np.float32(0.0)), np.float32(width - 1))
    v = min(max(v, np.float32(0.0)), np.float32(height - 1))
    x, y = int(u), int(v)
    x, y = min(x, max(width - 2, 0)), min(y, max(height - 2, 0))
    a, b, one = u - np.float32(x), v - np.float32(y), np.float32(1.0)
    weights = ((one - a) * (one - b), a * (one - b), (one - a) * b, a * b)
    return (y, min(y + 1, height - 1)), (x, min(x + 1, width - 1)), weights, inside


@kernel(fastmath=True, error_model="numpy", nogil=True, inline="always")
def similarity_at(here, there, corners, weights, out):
    """Writes the similarity per group of a pixel's features with those between four pixels of a source."""
    (y, y1), (x, x1) = corners
    w00, w01, w10, w11 = weights
    f00, f01, f10, f11 = there[y, x], there[y, x1], there[y1, x], there[y1, x1]
    for c in range(0, here.shape[0], GROUPS):
        for g in range(GROUPS):
            k = c + g
            out[g] += here[k] * (w00 * f00[k] + w01 * f01[k] + w10 * f10[k] + w11 * f11[k])


@kernel(fastmath=True, error_model="numpy", nogil=True)
def _forward(geometry, first, similarity, inside):
    maps, sources, at_infinity, parallax, inverse = geometry
    height, width = maps.shape[1:3]
    for view in range(sources.shape[0]):
        for n in range(sources.shape[1]):
            other = sources[view, n]
            for d in range(inverse.shape[1]):
                for p in range(height * width):
                    rows, columns, weights, within = sample_at(
                        at_infinity[view, n], parallax[view, n], p, inverse[view, d, p], height, width
                    )
                    inside[view, n, d, p] = within
                    out = similarity[view, n, d, p]
                    out[:] = 0.0
                    if within:
                        here = maps[first + view, p // width, p % width]
                        similarity_at(here, maps[other], (rows, columns), weights, out)


@kernel(fastmath=True, error_model="numpy", nogil=True)
def _backward(geometry, first, gradient, out):
    maps, sources, at_infinity, parallax, inverse = geometry
    _, height, width, channels = maps.shape
    for view in range(sources.shape[0]):
        for n in range(sources.shape[1]):
            other = sources[view, n]
            for d in range(inverse.shape[1]):
                for p in range(height * width):
                    (y, y1), (x, x1), (w00, w01, w10, w11), within = sample_at(
                        at_infinity[view, n], parallax[view, n], p, inverse[view, d, p], height, width
                    )
                    if not within:
                        continue
                    given = gradient[view, n, d, p]
                    row, column = p // width, p % width
                    here, to_here = maps[first + view, row, column], out[first + view, row, column]
                    f00, f01 = maps[other, y, x], maps[other, y, x1]
                    f10, f11 = maps[other, y1, x], maps[other, y1, x1]
                    t00, t01 = out[other, y, x], out[other, y, x1]
                    t10, t11 = out[other, y1, x], out[other, y1, x1]
                    for c in range(0, channels, GROUPS):
                        for g in range(GROUPS):
                            k = c + g
                            to_here[k] += given[g] * (w00 * f00[k] + w01 * f01[k] + w10 * f10[k] + w11 * f11[k])
                            back = given[g] * here[k]
                            t00[k] += w00 * back
                            t01[k] += w01 * back
                            t10[k] += w10 * back
                            t11[k] += w11 * back
