"""A box-shaped room seen by a fan of cameras, small enough for exact checks."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import pytest
import torch
from torch import Tensor

from vg2gt.geometry.cameras import invert_rigid, ray_directions
from vg2gt.method import CoarseModule, DenseHead, FineModule, PointMLP, PTv3
from vg2gt.types import Cameras, Geometry, Tokens, Voxels

PATCH = 14
TOKEN_DIM = 24
TAPS = 2

Inputs = tuple[Tokens, Geometry, Tensor]


def room(scenes: int = 1, views: int = 3, size: tuple[int, int] = (42, 84), seed: int = 0) -> Inputs:
    """Random tokens and images, exact depth of a box of 3.2 x 1.4 x 3 units around cameras that pan and slide."""
    generator = torch.Generator().manual_seed(seed)
    height, width = size
    angle = 0.15 * (torch.arange(views) - views / 2)
    poses = torch.eye(4).repeat(scenes, views, 1, 1)
    poses[..., 0, 0] = poses[..., 2, 2] = angle.cos()
    poses[..., 0, 2], poses[..., 2, 0] = -angle.sin(), angle.sin()
    poses[..., 0, 3] = 0.07 * torch.arange(views)
    focal = 0.55 * width
    intrinsics = torch.tensor([[focal, 0, width / 2 - 0.3], [0, focal, height / 2 - 0.3], [0, 0, 1]])
    cameras = Cameras(poses, intrinsics.expand(scenes, views, 3, 3), size)
    to_world = invert_rigid(poses)
    rays = ray_directions(cameras.intrinsics, size) @ to_world[..., :3, :3].mT[:, :, None]
    walls = torch.tensor([1.6, 0.7, 1.5]) * (1 + 0.03 * torch.arange(scenes))[:, None]
    origin = to_world[..., None, None, :3, 3]
    depth = ((rays.sign() * walls[:, None, None, None] - origin) / rays).amin(-1)
    depth = depth * (1 + 0.01 * torch.randn(depth.shape, generator=generator))
    confidence = 1 + 4 * torch.rand(depth.shape, generator=generator)
    grid = (height // PATCH, width // PATCH)
    shape = (scenes, views, grid[0] * grid[1], TOKEN_DIM)
    patch = tuple(torch.randn(shape, generator=generator) for _ in range(TAPS))
    tokens = Tokens(patch, torch.randn(scenes, views, 8, generator=generator), grid, size)
    images = torch.rand(scenes, views, 3, height, width, generator=generator)
    return tokens, Geometry(depth, confidence, cameras, torch.ones(scenes)), images


def take_views(inputs: Inputs, views: list[int]) -> Inputs:
    tokens, geometry, images = inputs
    picked = replace(
        geometry,
        depth=geometry.depth[:, views],
        depth_conf=geometry.depth_conf[:, views],
        cameras=geometry.cameras.select(torch.tensor(views)),
    )
    tokens = replace(tokens, patch=tuple(tap[:, views] for tap in tokens.patch), camera=tokens.camera[:, views])
    return tokens, picked, images[:, views]


@pytest.fixture
def make_room() -> Callable[..., Inputs]:
    return room


def small_ptv3(in_channels: int = 8, **options) -> PTv3:
    torch.manual_seed(0)
    widths = {"enc_channels": (16, 32, 48), "enc_depths": (1, 1, 1), "enc_heads": (2, 4, 6), "dec_channels": (24, 32)}
    heads = {"dec_depths": (1, 1), "dec_heads": (2, 4), "window": 16, "stem_kernel": 3, "mlp_ratio": 2, "drop_path": 0}
    return PTv3(in_channels, **{**widths, **heads, **options})


@pytest.fixture
def make_ptv3() -> Callable[..., PTv3]:
    return small_ptv3


@pytest.fixture
def make_coarse() -> Callable[..., CoarseModule]:
    def make(**options) -> CoarseModule:
        torch.manual_seed(0)
        defaults = {"ptv3": small_ptv3, "voxel_size": 0.125, "hidden": (16, 12), "fuse_channels": 16}
        defaults |= {"token_dims": [TOKEN_DIM] * TAPS, "patch_size": PATCH}
        return CoarseModule(**{**defaults, **options})

    return make


class WholeScenes(FineModule):
    """Pools and refines, as :class:`vg2gt.model.VG2GT` does."""

    def forward(self, tokens: Tokens, geometry: Geometry, images: Tensor, coarsen: Tensor | None = None) -> Voxels:
        size = self.voxel_edges(geometry, coarsen)
        return self.refine(self.pool(tokens, geometry, images, size), size)


@pytest.fixture
def make_fine() -> Callable[..., FineModule]:
    def make(**options) -> FineModule:
        torch.manual_seed(0)
        defaults = {
            "dense_head": partial(DenseHead, features=8, out_channels=12, merge_channels=6, finest=2),
            "point_mlp": partial(PointMLP, channels=16, window=8),
            "voxel_size": 0.125,
            "min_footprint": 0.0,
        }
        return WholeScenes([TOKEN_DIM] * TAPS, PATCH, **{**defaults, **options})

    return make


@pytest.fixture
def random_voxels() -> Callable[..., tuple[Tensor, Tensor]]:
    """Distinct random cells, sorted by scene: ``(grid, batch)``."""

    def make(counts: tuple[int, ...] = (90, 60), extent: int = 12, seed: int = 0) -> tuple[Tensor, Tensor]:
        generator = torch.Generator().manual_seed(seed)
        grids = []
        for count in counts:
            cells = torch.randperm(extent**3, generator=generator)[:count].sort().values
            grids.append(torch.stack((cells // extent**2, cells // extent % extent, cells % extent), -1) - extent // 2)
        batch = torch.arange(len(counts)).repeat_interleave(torch.tensor(counts))
        return torch.cat(grids), batch

    return make
