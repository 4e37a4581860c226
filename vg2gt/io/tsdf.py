"""TSDF fusion: fuses depth maps into a truncated signed distance, only on blocks of voxels near surfaces.

A view measures the difference in z between a surface and a voxel. At grazing angles this overestimates the distance and
would bias the mean outwards. Observations are therefore weighted by the squared cosine between ray and normal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from vg2gt.geometry.cameras import ray_directions, unproject
from vg2gt.geometry.normals import normals_from_depth
from vg2gt.types import Cameras

BLOCK = 8  # voxels along a block's edge
KEY_BITS = 20  # voxel indices lie in [-2^20, 2^20)
_BLOCKS_PER_CHUNK = 2048
_EDGE_WEIGHT = 0.05  # of pixels without a normal (at edges, in sparse depth): better than no observation
_MIN_WEIGHT = 1e-3


@dataclass(frozen=True, eq=False)
class Volume:
    """A truncated signed distance sampled at voxel centres of N blocks.

    Attributes:
        blocks: ``[N, 3]`` int64 block indices, unique; a block starts at voxel ``BLOCK * index``.
        distance: ``[N, BLOCK^3]`` float32 mean signed distance over the truncation, in [-1, 1], positive in free space.
        weight: ``[N, BLOCK^3]`` float32 summed weight of the observations; 0 = never observed.
        colors: ``[N, BLOCK^3, 3]`` float32 mean colour in [0, 1], or None.
        voxel_size: edge length of a voxel; the centre of voxel i is at ``(i + 1/2) * voxel_size``.
    """

    blocks: Tensor
    distance: Tensor
    weight: Tensor
    colors: Tensor | None
    voxel_size: float


def fuse(
    depth: Tensor, cameras: Cameras, colors: Tensor | None, voxel_size: float, truncation: float, max_voxels: int
) -> Volume:
    """Fuses z-depth maps ``[V, H, W]`` of one scene; arguments as in :func:`vg2gt.io.mesh.fuse_depth`."""
    blocks = _surface_blocks(depth, cameras, voxel_size, truncation, max_voxels)
    inside = torch.stack(torch.meshgrid(*3 * [torch.arange(BLOCK)], indexing="ij"), -1).reshape(-1, 3)
    size = (len(blocks), BLOCK**3)
    distance, weight = torch.zeros(size), torch.zeros(size)
    shade = None if colors is None else torch.zeros(*size, 3)
    views = [_view(depth, cameras, colors, index) for index in range(len(depth))]
    for start in range(0, len(blocks), _BLOCKS_PER_CHUNK):
        rows = slice(start, start + _BLOCKS_PER_CHUNK)
        centers = ((blocks[rows, None] * BLOCK + inside) + 0.5) * voxel_size
        for view in views:
            _integrate(centers, view, truncation, distance[rows], weight[rows], None if shade is None else shade[rows])
    seen = weight.clamp(min=_MIN_WEIGHT)
    return Volume(blocks, distance / seen, weight, None if shade is None else shade / seen[..., None], voxel_size)


def _surface_blocks(depth: Tensor, cameras: Cameras, voxel_size: float, truncation: float, max_voxels: int) -> Tensor:
    """Blocks with a point within the truncation in front of or behind a depth sample, sorted, unique."""
    steps = int(np.ceil(2 * truncation / (BLOCK * voxel_size / 2))) + 1
    offsets = torch.linspace(-truncation, truncation, steps, dtype=torch.float64).tolist()
    # includes neighbouring voxels: the surface may pass between two blocks
    around = torch.stack(torch.meshgrid(*3 * [torch.tensor([-1, 1])], indexing="ij"), -1).reshape(-1, 3)
    limit = (1 << KEY_BITS) - BLOCK
    blocks = torch.zeros(0, dtype=torch.int64)
    for view in range(len(depth)):
        valid = depth[view] > 0
        for offset in offsets:
            shifted = (depth[view] + offset) * valid
            points = unproject(shifted[None, None], cameras.select(slice(view, view + 1)))[0, 0][shifted > 0]
            index = torch.floor(points / voxel_size)
            if len(index) and index.abs().max() >= limit:
                raise ValueError(
                    f"the scene reaches {points.abs().max():.4g} units from the origin, more than {limit} voxels of "
                    f"{voxel_size:g}; set far depth to 0 or take larger voxels"
                )
            voxels = unpack(torch.unique(pack(index.long())))
            touched = torch.div(voxels[:, None] + around, BLOCK, rounding_mode="floor")
            blocks = torch.unique(torch.cat((blocks, pack(touched.reshape(-1, 3)))))
        if len(blocks) * BLOCK**3 > max_voxels:
            raise ValueError(
                f"the surfaces need more than max_voxels={max_voxels} voxels of {voxel_size:g}; take larger voxels, "
                "set far depth to 0, or raise max_voxels"
            )
    return unpack(blocks)


@dataclass(frozen=True, eq=False)
class _View:
    """One depth map with its camera: z-depth and weight ``[H, W]``, colour ``[3, H, W]``."""

    depth: Tensor
    weight: Tensor
    color: Tensor | None
    world_to_camera: Tensor
    intrinsics: Tensor


def _view(depth: Tensor, cameras: Cameras, colors: Tensor | None, index: int) -> _View:
    intrinsics = cameras.intrinsics[0, index]
    rays = ray_directions(intrinsics, cameras.size)
    normals, valid = normals_from_depth(depth[index], intrinsics)
    cosine = (normals.permute(1, 2, 0) * rays).sum(-1) / rays.norm(dim=-1)
    return _View(
        depth[index],
        torch.where(valid, cosine.square().clamp(min=_MIN_WEIGHT), _EDGE_WEIGHT),
        None if colors is None else colors[index],
        cameras.world_to_camera[0, index],
        intrinsics,
    )


def _integrate(
    centers: Tensor, view: _View, truncation: float, distance: Tensor, weight: Tensor, shade: Tensor | None
) -> None:
    """Adds one view to the weighted sums of distance, weight and colour of voxels with the given centres, in place."""
    local = centers.float() @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3]
    z = local[..., 2]
    safe = z.clamp(min=1e-6)
    x = local[..., 0] / safe * view.intrinsics[0, 0] + view.intrinsics[0, 2]
    y = local[..., 1] / safe * view.intrinsics[1, 1] + view.intrinsics[1, 2]
    height, width = view.depth.shape
    visible = (z > 1e-6) & (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)
    pick = torch.nonzero(visible.reshape(-1))[:, 0]
    x, y, z = (values.reshape(-1)[pick] for values in (x, y, z))
    surface = _sample_depth(view.depth, x, y, truncation)
    keep = (surface > 0) & (surface - z > -truncation)
    pick, column, row = pick[keep], x[keep].round().long(), y[keep].round().long()
    signed = (surface - z)[keep] / truncation
    share = view.weight[row, column]
    distance.view(-1)[pick] += share * signed.clamp(max=1)
    weight.view(-1)[pick] += share
    if shade is not None and view.color is not None:
        shade.view(-1, 3)[pick] += share[:, None] * view.color[:, row, column].T


def _sample_depth(depth: Tensor, x: Tensor, y: Tensor, truncation: float) -> Tensor:
    """Samples depth bilinearly if the four neighbours are on one surface, else nearest, so that edges stay sharp."""
    height, width = depth.shape
    left, top = x.floor().long().clamp(0, width - 2), y.floor().long().clamp(0, height - 2)
    fx, fy = (x - left).clamp(0, 1), (y - top).clamp(0, 1)
    corners = torch.stack([depth[top + j, left + i] for j in (0, 1) for i in (0, 1)])
    weights = torch.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
    smooth = (corners.amin(0) > 0) & (corners.amax(0) - corners.amin(0) < truncation)
    nearest = depth[y.round().long().clamp(0, height - 1), x.round().long().clamp(0, width - 1)]
    return torch.where(smooth, (corners * weights).sum(0), nearest)


def pack(index: Tensor) -> Tensor:
    """Packs indices ``[..., 3]`` into int64 keys ``[...]`` that sort lexicographically."""
    shifted = index + (1 << KEY_BITS)
    x, y, z = shifted.unbind(-1)
    return (x << (2 * KEY_BITS + 2)) | (y << (KEY_BITS + 1)) | z


def unpack(keys: Tensor) -> Tensor:
    """Inverse of :func:`pack`."""
    mask = (1 << (KEY_BITS + 1)) - 1
    parts = (keys >> (2 * KEY_BITS + 2), (keys >> (KEY_BITS + 1)) & mask, keys & mask)
    return torch.stack(parts, -1) - (1 << KEY_BITS)
