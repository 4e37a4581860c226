"""Resizing and cropping: images, depth, mask and intrinsics stay together."""

import pytest
import torch

from vg2gt.data import Frames, SceneDataModule, SyntheticScenes
from vg2gt.data.transforms import resize, resize_to_cover
from vg2gt.geometry.cameras import ray_directions


def _rays(height: int = 60, width: int = 80, sparse: bool = False) -> Frames:
    """Frames whose colours are the rays' directions and whose depth is the ray's x: pixels tell where they are."""
    intrinsics = torch.tensor([[90.0, 0, 38.2], [0, 85.0, 30.9], [0, 0, 1]])[None]
    rays = ray_directions(intrinsics, (height, width))[0]
    images = (rays * torch.tensor([1.0, 1.0, 0.5]) + torch.tensor([0.5, 0.5, 0.0])).permute(2, 0, 1)[None]
    return Frames(images, rays[None, ..., 0] + 1, torch.eye(4)[None], intrinsics, sparse)


@pytest.mark.parametrize("size", [(28, 56), (42, 28), (70, 70), (98, 126), (60, 80)])
def test_pixels_and_intrinsics_agree(size):
    framed = resize_to_cover(_rays(), size)
    assert framed.images.shape[-2:] == framed.depth.shape[-2:] == size
    expected = ray_directions(framed.intrinsics, size)[0]
    inside = (slice(1, -1), slice(1, -1))
    colors = framed.images[0, :2].permute(1, 2, 0) - 0.5
    assert float((colors - expected[..., :2]).abs()[inside].max()) < 0.1 / 85  # 0.1 pixels
    assert float((framed.depth[0] - 1 - expected[..., 0]).abs()[inside].max()) < 0.51 / 90  # the nearest pixel
    center = framed.intrinsics[0, :2, 2] - framed.intrinsics[0, 0, 0] / 90 * torch.tensor([38.2 - 39.5, 30.9 - 29.5])
    assert (center - torch.tensor([(size[1] - 1) / 2, (size[0] - 1) / 2])).abs().max() <= 1.1  # the middle stays


def test_sparse_depth_is_moved():
    frames = _rays(sparse=True)
    frames.depth[:, ::2] = 0
    framed = resize_to_cover(frames, (84, 112))
    expected = ray_directions(framed.intrinsics, (84, 112))[0, ..., 0]
    valid = framed.depth[0] > 0
    assert 0 < valid.float().mean() < 0.6
    assert float((framed.depth[0] - 1 - expected).abs()[valid].max()) < 0.51 / 90


def test_colour_is_averaged_and_depth_never():
    depth = torch.randint(1, 5, (2, 30, 40)).float()
    rows, columns = torch.meshgrid(torch.arange(30), torch.arange(40), indexing="ij")
    images = ((rows + columns) % 2).float().expand(2, 3, 30, 40)
    frames = Frames(images, depth, torch.eye(4).expand(2, 4, 4), torch.eye(3).expand(2, 3, 3))
    resized = resize(frames, (10, 13))
    assert set(resized.depth.unique().tolist()) <= {1.0, 2.0, 3.0, 4.0}
    assert (resized.images - 0.5).abs().max() < 0.1


@pytest.mark.parametrize("size", [56, (56,), "56", (0, 56)])
def test_impossible_sizes_are_refused(size):
    with pytest.raises(ValueError, match=r"data\.image_size must be \[height, width\] in pixels, got"):
        SceneDataModule(SyntheticScenes(1), SyntheticScenes(1, first_seed=9), image_size=size)
