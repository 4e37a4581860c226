"""Similarity of views with their sources at hypothetical depths: torch reference and a compiled CPU kernel."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.geometry.cameras import pixel_grid
from vg2gt.kernels.compiled import kernel

GROUPS = 8  # of channels c with equal c % GROUPS, whose products are averaged
_IN_FRONT = 1e-3  # a point is not visible in a source below this ratio of its depth there to its depth here


class Projections(NamedTuple):
    """Maps pixel (x, y) of V views at depth d to their n sources: ``d * turn @ (x, y, 1) + shift``, in image pixels.

    Attributes:
        sources: indices of the sources ``[V, n]``.
        turn: ``[V, n, 3, 3]``.
        shift: ``[V, n, 3]``.
    """

    sources: Tensor
    turn: Tensor
    shift: Tensor

    @classmethod
    def between(cls, world_to_camera: Tensor, intrinsics: Tensor, sources: Tensor) -> Projections:
        """Projections from cameras ``[V, 4, 4]`` with intrinsics ``[V, 3, 3]`` to their sources ``[V, n]``."""
        matrices = world_to_camera.clone()  # rounded in the order of the published code
        matrices[:, :3] = intrinsics @ world_to_camera[:, :3]
        both = matrices[sources] @ torch.linalg.inv(matrices)[:, None]  # [V, n, 4, 4]
        return cls(sources, both[..., :3, :3].contiguous(), both[..., :3, 3].contiguous())

    def select(self, views: slice, sources: slice = slice(None)) -> Projections:
        """Returns those of some views and some of their sources."""
        return Projections(*(each[views, sources] for each in self))


class Hypotheses(NamedTuple):
    """Points at which features are compared.

    Attributes:
        depth: depths ``[V, D, h, w]`` of every ``stride``-th image pixel.
        stride: image size over ``(h, w)``.
        reduction: image size over the size of the sources' features.
    """

    depth: Tensor
    stride: int
    reduction: int


def similarity(own: Tensor, features: Tensor, projections: Projections, points: Hypotheses, weights: Tensor) -> Tensor:
    """Compares views with their sources.

    Args:
        own: features of the V views ``[V, C, h, w]``; C a multiple of ``GROUPS``. Channels-last ones are faster.
        features: features of all N views ``[N, C, ., .]``, which have their own resolution.
        projections: projections of the V views.
        points: where to compare.
        weights: weights of the sources ``[V, n, h, w]``.

    Returns:
        Weighted sum over the sources of the mean products of groups of channels ``[V, GROUPS, D, h, w]``; features
        are 0 outside the source.
    """
    if own.device.type != "cpu" or own.dtype != torch.float32:
        return similarity_reference(own, features, projections, points, weights)
    rows = (own.permute(0, 2, 3, 1), features.permute(0, 2, 3, 1))
    views, planes, height, width = points.depth.shape
    found = torch.zeros(views, planes, height, width, GROUPS)
    tensors = [each.contiguous().numpy() for each in (*rows, *projections, points.depth, weights)]
    _accumulate(tuple(tensors), points.stride, 1 / points.reduction, found.numpy())
    return found.permute(0, 4, 1, 2, 3)


def similarity_reference(
    own: Tensor, features: Tensor, projections: Projections, points: Hypotheses, weights: Tensor
) -> Tensor:
    """:func:`similarity` in plain torch, for all devices and dtypes."""
    total = own.new_zeros(())
    here = points.stride * pixel_grid(own.shape[-2], own.shape[-1], own)  # [h, w, 2]
    for source in range(projections.sources.shape[1]):
        turn, shift = projections.turn[:, source], projections.shift[:, source, None, None, None]
        rays = here @ turn[:, None, :, :2].mT + turn[:, None, None, :, 2]  # [V, h, w, 3]
        there = rays[:, None] * points.depth[..., None] + shift  # [V, D, h, w, 3]
        visible = there[..., 2:] > _IN_FRONT * points.depth[..., None]
        pixels = torch.where(visible, there[..., :2] / there[..., 2:], -1e6) / points.reduction
        maps = features[projections.sources[:, source]]
        grid = (2 * pixels + 1) / pixels.new_tensor([maps.shape[-1], maps.shape[-2]]) - 1
        sampled = F.grid_sample(maps, grid.flatten(1, 2), padding_mode="zeros", align_corners=False)  # [V, C, D h, w]
        product = sampled.unflatten(2, points.depth.shape[1:3]) * own[:, :, None]
        total = total + product.unflatten(1, (-1, GROUPS)).mean(1) * weights[:, source, None, None]
    return total


@kernel(fastmath={"contract"}, error_model="numpy", nogil=True)
def _accumulate(tensors, stride, scale, out):
    own, features, sources, turns, shifts, depth, weights = tensors
    views, planes, height, width = depth.shape
    _, rows, columns, channels = features.shape
    one, share = np.float32(1), np.float32(GROUPS / channels)
    scale, least = np.float32(scale), np.float32(_IN_FRONT)
    for view in range(views):
        for n in range(sources.shape[1]):
            maps, turn, shift = features[sources[view, n]], turns[view, n], shifts[view, n]
            for y in range(height):
                for x in range(width):
                    column, row = np.float32(stride * x), np.float32(stride * y)
                    ray_x = turn[0, 0] * column + turn[0, 1] * row + turn[0, 2]
                    ray_y = turn[1, 0] * column + turn[1, 1] * row + turn[1, 2]
                    ray_z = turn[2, 0] * column + turn[2, 1] * row + turn[2, 2]
                    here, weight = own[view, y, x], weights[view, n, y, x] * share
                    for plane in range(planes):
                        d = depth[view, plane, y, x]
                        z = ray_z * d + shift[2]
                        if z <= least * d:
                            continue
                        u = (ray_x * d + shift[0]) / z * scale
                        v = (ray_y * d + shift[1]) / z * scale
                        if not (u > -1 and v > -1 and u < columns and v < rows):
                            continue
                        left, top = int(np.floor(u)), int(np.floor(v))
                        a, b = u - np.float32(left), v - np.float32(top)
                        # features outside are 0
                        west, east = (one - a) * (left >= 0), a * (left + 1 < columns)
                        north, south = (one - b) * (top >= 0) * weight, b * (top + 1 < rows) * weight
                        w00, w01, w10, w11 = west * north, east * north, west * south, east * south
                        first, last = max(left, 0), min(left + 1, columns - 1)
                        above, below = max(top, 0), min(top + 1, rows - 1)
                        f00, f01 = maps[above, first], maps[above, last]
                        f10, f11 = maps[below, first], maps[below, last]
                        into = out[view, plane, y, x]
                        for c in range(0, channels, GROUPS):
                            for g in range(GROUPS):
                                k = c + g
                                into[g] += here[k] * (w00 * f00[k] + w01 * f01[k] + w10 * f10[k] + w11 * f11[k])
