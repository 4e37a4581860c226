"""Measured depth that does not lie on the images is found by its steps and their edges."""

from dataclasses import replace

import pytest

from tests.data.sources.layout_rgbd import write_recording
from vg2gt.data import SyntheticScenes
from vg2gt.inputs.given_cameras import given_pictures
from vg2gt.reconstruction.measured_depth import offset_of_depth


@pytest.mark.parametrize("shift", [(0, 0), (0, 6), (-5, -4), (1, 1)])
def test_depth_that_is_not_aligned_to_the_colours_is_found(tmp_path, shift: tuple[int, int]) -> None:
    source = SyntheticScenes(1, num_frames=12, size=(168, 224))
    frames = source.load(source.scenes[0], range(12))
    recording = write_recording(tmp_path, replace(frames, depth=frames.depth.roll(shift, (1, 2))))
    pictures = given_pictures(recording, depth=True)
    assert pictures is not None
    down, right = shift
    assert offset_of_depth(pictures) == (None if max(abs(down), abs(right)) < 3 else (right, down))
