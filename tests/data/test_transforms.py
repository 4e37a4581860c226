"""Resizing and cropping keep images, depth and intrinsics together; pixels and intrinsics agree in test_framing.py."""

import torch

from vg2gt.data import Frames
from vg2gt.data.transforms import resize, resize_to_cover


def test_colour_is_averaged_and_depth_never():
    depth = torch.randint(1, 5, (2, 30, 40)).float()
    rows, columns = torch.meshgrid(torch.arange(30), torch.arange(40), indexing="ij")
    images = ((rows + columns) % 2).float().expand(2, 3, 30, 40)
    frames = Frames(images, depth, torch.eye(4).expand(2, 4, 4), torch.eye(3).expand(2, 3, 3))
    resized = resize(frames, (10, 13))
    assert set(resized.depth.unique().tolist()) <= {1.0, 2.0, 3.0, 4.0}
    assert (resized.images - 0.5).abs().max() < 0.1


def test_cover_fills_the_target_and_keeps_the_centre():
    intrinsics = torch.tensor([[50.0, 0, 19.5], [0, 50.0, 14.5], [0, 0, 1]])[None]
    frames = Frames(torch.rand(1, 3, 30, 40), torch.ones(1, 30, 40), torch.eye(4)[None], intrinsics)
    for size in ((28, 28), (14, 42), (60, 80), (30, 40)):
        out = resize_to_cover(frames, size)
        assert out.images.shape[-2:] == out.depth.shape[-2:] == size
        center = out.intrinsics[0, :2, 2]
        assert (center - torch.tensor([(size[1] - 1) / 2, (size[0] - 1) / 2])).abs().max() <= 0.51
        focal = 50 * max(size[0] / 30, size[1] / 40)
        assert abs(float(out.intrinsics[0, 0, 0]) - focal) < 0.03 * focal
