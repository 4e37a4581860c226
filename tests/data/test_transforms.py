"""Resizing, cropping and padding: images, depth, mask and intrinsics stay together."""

import pytest
import torch

from vg2gt.data import Frames, SceneDataModule, SyntheticScenes
from vg2gt.data.transforms import resize, resize_to_cover, resize_to_fit
from vg2gt.geometry.cameras import ray_directions

from .conftest import module_of


def _rays(height: int = 60, width: int = 80, sparse: bool = False) -> Frames:
    """Frames whose colours are the rays' directions and whose depth is the ray's x: pixels tell where they are."""
    intrinsics = torch.tensor([[90.0, 0, 38.2], [0, 85.0, 30.9], [0, 0, 1]])[None]
    rays = ray_directions(intrinsics, (height, width))[0]
    images = (rays * torch.tensor([1.0, 1.0, 0.5]) + torch.tensor([0.5, 0.5, 0.0])).permute(2, 0, 1)[None]
    return Frames(images, rays[None, ..., 0] + 1, torch.eye(4)[None], intrinsics, sparse)


@pytest.mark.parametrize("frame", [resize_to_cover, resize_to_fit])
@pytest.mark.parametrize("size", [(28, 56), (42, 28), (70, 70), (98, 126), (60, 80)])
def test_pixels_and_intrinsics_agree(frame, size):
    framed = frame(_rays(), size)
    assert framed.images.shape[-2:] == framed.depth.shape[-2:] == size
    expected = ray_directions(framed.intrinsics, size)[0]
    inside = framed.images[0, 2] > 0.499  # black: padded
    inside[1:-1, 1:-1] &= (inside[:-2, 1:-1] & inside[2:, 1:-1] & inside[1:-1, :-2] & inside[1:-1, 2:]).clone()
    inside[[0, -1]] = inside[:, [0, -1]] = False
    assert inside.float().mean() > 0.4
    colors = framed.images[0, :2].permute(1, 2, 0) - 0.5
    assert float((colors - expected[..., :2]).abs()[inside].max()) < 0.1 / 85  # 0.1 pixels
    assert float((framed.depth[0] - 1 - expected[..., 0]).abs()[inside].max()) < 0.51 / 90  # the nearest pixel
    assert not framed.depth[0][framed.images[0, 2] == 0].any()
    if frame is resize_to_cover:
        center = framed.intrinsics[0, :2, 2] - framed.intrinsics[0, 0, 0] / 90 * torch.tensor(
            [38.2 - 39.5, 30.9 - 29.5]
        )
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


@pytest.mark.parametrize(
    "options", [{"fit": "squeeze"}, *({"image_size": size} for size in (56, (56,), "56", (0, 56)))]
)
def test_impossible_framings_are_refused(options):
    with pytest.raises(
        ValueError, match=r"data\.(fit must be one of|image_size must be \[height, width\] in pixels, got)"
    ):
        SceneDataModule(SyntheticScenes(1), SyntheticScenes(1, first_seed=9), **options)


def test_padded_batches_hold_whole_frames(rooms):
    batch = next(iter(module_of(rooms, image_size=(14, 28), fit="pad").train_dataloader()))
    assert batch.images.shape[-2:] == (14, 28)
    assert not batch.depth[..., :, :4].any()
    assert not batch.depth[..., :, -4:].any()
    assert batch.depth[..., 8:20].all()
    assert not batch.mask[..., :4].any()
    assert (batch.mask[..., 8:20] == 1).all()
