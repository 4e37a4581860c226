"""What the round trips of capture apps' exports do not show: coarser depth, confidence, choices of files, messages."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from vg2gt.data import RGBDFolder
from vg2gt.io import FormatError
from vg2gt.io.video import read_frame, read_video

from .layout_phone import write_polycam, write_stray
from .layouts import SIZE, room, save


def test_depth_is_coarser_and_not_to_be_trusted_everywhere(tmp_path: Path) -> None:
    frames = room(3)
    write_polycam(tmp_path, frames, corrected=False)
    folder = tmp_path / "kitchen" / "keyframes"
    for path in (folder / "depth").iterdir():
        with Image.open(path) as image:
            depth = np.array(image)[::2, ::2]
        save(path, depth)
        confidence = np.full(depth.shape, 255, np.uint8)
        confidence[:4] = 0
        save(folder / "confidence" / path.name, confidence)
    source = RGBDFolder(str(tmp_path), holdout=None)
    loaded = source.load("kitchen", source.frames("kitchen"))
    assert loaded.depth.shape == (3, SIZE[0] // 2, SIZE[1] // 2)
    assert not loaded.depth[:, :4].any()
    assert (loaded.depth[:, 4:] > 0).all()
    expected = frames.intrinsics.double().clone()
    expected[:, :2] /= 2
    expected[:, :2, 2] -= 0.25  # the middle of the first pixel is at 0, of however many it was made
    torch.testing.assert_close(loaded.intrinsics, expected.float(), atol=1e-4, rtol=0)


def test_frames_of_a_video_are_found_alone(tmp_path: Path) -> None:
    write_stray(tmp_path, room(6))
    video = tmp_path / "71de12f9" / "rgb.mp4"
    whole = dict(read_video(video))
    for number in (4, 0, 5):
        assert np.array_equal(read_frame(video, number), whole[number])
    with pytest.raises(FormatError, match=r"rgb\.mp4 has 6 frames, but frame 6 was requested"):
        read_frame(video, 6)
