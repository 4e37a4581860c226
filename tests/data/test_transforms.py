"""Resizing and cropping keep images, depth and intrinsics together."""

import torch

from vg2gt.data import Frames
from vg2gt.data.synthetic.renderer import render_frame
from vg2gt.data.synthetic.rooms import SyntheticRoom
from vg2gt.data.transforms import crop, resize, resize_to_cover


def _render(room: SyntheticRoom, intrinsics: torch.Tensor, size: tuple[int, int]) -> Frames:
    frame = render_frame(room.world, room.world_to_camera[0], intrinsics.double().numpy(), size)
    images = torch.from_numpy(frame.image).permute(2, 0, 1)[None] / 255
    pose = torch.from_numpy(room.world_to_camera[:1]).float()
    return Frames(images, torch.from_numpy(frame.depth)[None], pose, intrinsics[None].float())


def test_a_resized_and_cropped_rendering_is_a_rendering_at_the_new_intrinsics():
    room = SyntheticRoom(4, 1, (90, 120))
    large = _render(room, torch.from_numpy(room.intrinsics), (90, 120))
    small = resize_to_cover(large, (28, 42))
    expected = _render(room, small.intrinsics[0], (28, 42))
    interior = (slice(None), slice(1, -1), slice(1, -1))
    assert (small.images - expected.images).abs().mean() < 0.02
    shifted = small.intrinsics[0].clone()
    shifted[0, 2] += 0.5  # half a pixel wrong must show
    wrong = _render(room, shifted, (28, 42))
    error, wrong_error = ((small.images - other.images).abs().mean() for other in (expected, wrong))
    assert error < 0.6 * wrong_error
    relative = ((small.depth - expected.depth).abs() / expected.depth)[interior]
    assert relative.median() < 0.01


def test_depth_is_never_averaged():
    depth = torch.randint(1, 5, (2, 30, 40)).float()
    frames = Frames(torch.rand(2, 3, 30, 40), depth, torch.eye(4).expand(2, 4, 4), torch.eye(3).expand(2, 3, 3))
    resized = resize(frames, (13, 17)).depth
    assert set(resized.unique().tolist()) <= {1.0, 2.0, 3.0, 4.0}


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


def test_crop_takes_the_window():
    frames = Frames(torch.rand(1, 3, 8, 9), torch.rand(1, 8, 9), torch.eye(4)[None], torch.eye(3)[None])
    out = crop(frames, 2, 3, (4, 5))
    assert torch.equal(out.images, frames.images[..., 2:6, 3:8])
    assert torch.equal(out.depth, frames.depth[..., 2:6, 3:8])
    assert out.intrinsics[0, :2, 2].tolist() == [-3, -2]
