"""Frames that cannot be read: replaced and counted in training, an error in evaluation."""

import logging
from functools import partial
from pathlib import Path

import pytest
import torch

from vg2gt.data import DataError, RGBDFolder
from vg2gt.data.batches import BatchDataset
from vg2gt.data.transforms import resize_to_cover
from vg2gt.data.views import SceneSample

from .conftest import SIZE


def _dataset(folder: Path, memory_mb: int = 10, **options) -> BatchDataset:
    source = RGBDFolder(str(folder), holdout=None)
    return BatchDataset(source, partial(resize_to_cover, size=SIZE), memory_mb, **options)


def _truncate(folder: Path, *names: str) -> None:
    for name in names:
        path = folder / name
        path.write_bytes(path.read_bytes()[:-200])


def test_the_nearest_readable_frame_takes_the_place_of_a_damaged_one_in_training_only(write_recording, caplog):
    folder = write_recording(frames=6)  # frames 10 .. 15
    _truncate(folder, "images/00012.png", "depth/00013.png")
    views = (SceneSample("office", (12, 10, 13), (15,)),)
    dataset = _dataset(folder, replace_damaged=True)
    with caplog.at_level(logging.WARNING):
        batch = dataset[views]
    assert batch.frame_ids.tolist() == [[11, 10, 14, 15]]
    direct = dataset.source.load("office", [11, 10, 14, 15])
    assert torch.equal(batch.cameras.world_to_camera[0], direct.world_to_camera)
    assert torch.equal(batch.depth[0], direct.depth)
    warnings = [record.getMessage() for record in caplog.records]
    assert len(warnings) == 2
    assert "frame 12 of scene office" in warnings[0]
    assert "00012.png" in warnings[0]
    assert "process: 2)" in warnings[1]
    assert "00013.png" in warnings[1]
    caplog.clear()
    assert dataset[views].frame_ids.tolist() == [[11, 10, 14, 15]]
    assert not caplog.records  # warned once
    others = [_dataset(folder, 0, replace_damaged=True), dataset]
    others[0][(SceneSample("office", (13, 14)),)]  # another history
    assert all(other[views].frame_ids.tolist() == [[11, 10, 14, 15]] for other in others)
    with pytest.raises(DataError, match=r"00012\.png of scene office"):
        _dataset(folder)[views]  # evaluation


def test_held_out_frames_never_step_in_and_a_scene_that_runs_out_is_named(write_recording):
    folder = write_recording(frames=6)
    _truncate(folder, "images/00010.png", "images/00013.png")
    source = RGBDFolder(str(folder), holdout=3)  # 11 and 14
    dataset = BatchDataset(source, partial(resize_to_cover, size=SIZE), 1, replace_damaged=True)
    assert dataset[(SceneSample("office", (10, 13)),)].frame_ids.tolist() == [[12, 15]]
    with pytest.raises(DataError, match="scene office has too few readable frames left for a sample of 3"):
        dataset[(SceneSample("office", (10, 12, 13)),)]
