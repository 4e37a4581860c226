"""Reduced frames on disk: the same batches, made once, made again when they must be."""

import logging
import time
from pathlib import Path
from typing import Any

import pytest
import torch

from vg2gt.data import Mixture, RGBDFolder, SceneDataModule, SyntheticScenes
from vg2gt.data.framing import FramingSampler
from vg2gt.data.resized_cache import ResizedCache
from vg2gt.data.transforms import reduce_to_cover

SMALL = (12, 16)
FRAMING = FramingSampler(SMALL)


@pytest.fixture
def recording(write_recording) -> RGBDFolder:
    return RGBDFolder(str(write_recording(frames=6)), holdout=None)


def _files(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.npz"))


def test_frames_are_decoded_once_and_come_back_the_same(recording, tmp_path, monkeypatch):
    cache = ResizedCache(recording, tmp_path / "cache", FRAMING)
    first = cache.load("office", [12, 10])
    expected = reduce_to_cover(recording.load("office", [12, 10]), SMALL)
    assert float((first.images - expected.images).abs().max()) <= 0.5 / 255 + 1e-6
    for name in ("depth", "world_to_camera", "intrinsics"):
        assert torch.equal(getattr(first, name), getattr(expected, name))
    assert len(_files(tmp_path / "cache")) == 2
    monkeypatch.setattr(RGBDFolder, "load", None)
    again = ResizedCache(recording, tmp_path / "cache", FRAMING).load("office", [12, 10])
    assert torch.equal(again.images, first.images)
    assert torch.equal(again.depth, first.depth)
    assert again.sparse_depth == first.sparse_depth


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"aspect": [0.5, 1.0], "zoom": [1, 1.2], "size_multiple": 2},
        {"fit": "pad", "image_size": (12, 24)},
        {"fit": "pad", "aspect": [0.5, 1.5], "size_multiple": 2},
    ],
)
def test_batches_are_those_without_a_cache(recording, tmp_path, options: dict[str, Any]):
    def batches(**more: Any) -> list:
        val = SyntheticScenes(1, num_frames=4, size=SMALL)
        module = SceneDataModule(
            recording, val, min_views=2, max_views=3, max_images=6, eval_context=[0],
            eval_target=[1], steps_per_epoch=5, **{"image_size": SMALL, **options}, **more,
        )  # fmt: skip
        return list(module.train_dataloader())

    plain = batches()
    for more in ({}, {"workers": 2}, {"memory_mb": 0}):
        for a, b in zip(plain, batches(resized_cache=str(tmp_path / "cache"), **more), strict=True):
            assert torch.equal(a.images, b.images)
            assert torch.equal(a.depth, b.depth)
            assert torch.equal(a.cameras.intrinsics, b.cameras.intrinsics)
    assert len(_files(tmp_path / "cache")) == 6


def test_a_damaged_file_is_made_again(recording, tmp_path, caplog):
    cache = ResizedCache(recording, tmp_path / "cache", FRAMING)
    first = cache.load("office", [11])
    (path,) = _files(tmp_path / "cache")
    content = path.read_bytes()
    for damage in (content[:300], content[:400] + b"x" + content[401:], b""):
        path.write_bytes(damage)
        with caplog.at_level(logging.WARNING):
            assert torch.equal(cache.load("office", [11]).images, first.images)
        assert "damaged and is made again" in caplog.text
        assert path.read_bytes() == content


def test_other_options_sizes_and_files_have_their_own_frames(recording, tmp_path):
    folder = Path(recording.scene_index("office").folder)
    sources = [recording, RGBDFolder(str(folder), depth_scale=500, holdout=3)]
    for source in sources:
        for size in (SMALL, (6, 8)):
            ResizedCache(source, tmp_path / "cache", FramingSampler(size)).load("office", [11])
    assert len(_files(tmp_path / "cache")) == 4
    ResizedCache(RGBDFolder(str(folder), holdout=5, every=2), tmp_path / "cache", FRAMING).load("office", [10])
    assert len({path.parent for path in _files(tmp_path / "cache")}) == 4  # which frames are chosen changes nothing
    before = ResizedCache(recording, tmp_path / "cache", FRAMING)._scene_folder("office")
    time.sleep(0.01)
    (folder / "K.txt").write_text((folder / "K.txt").read_text().replace("e+01", "e+02"))
    old = ResizedCache(recording, tmp_path / "cache", FRAMING)
    old._folders["office"] = before
    changed = ResizedCache(RGBDFolder(str(folder), holdout=None), tmp_path / "cache", FRAMING)
    assert changed.load("office", [11]).intrinsics[0, 0, 0] > 5 * old.load("office", [11]).intrinsics[0, 0, 0]


def test_everything_else_is_the_sources(recording, tmp_path):
    mixture = Mixture({"a": recording, "b": SyntheticScenes(2)}, {"a": 1, "b": 3})
    cache = ResizedCache(mixture, tmp_path, FRAMING)
    assert cache.scenes == mixture.scenes
    assert cache.parts() == {"a": 1, "b": 3}
    for scene in cache.scenes:
        for name in ("frames", "held_out", "place", "part", "scene_is_metric"):
            assert getattr(cache, name)(scene) == getattr(mixture, name)(scene)
    assert len({cache.identity(scene) for scene in cache.scenes}) == 3


def test_a_full_disk_ends_the_writing_only(recording, tmp_path, caplog):
    (tmp_path / "cache").write_text("a file where the folder should be")
    cache = ResizedCache(recording, tmp_path / "cache", FRAMING)
    with caplog.at_level(logging.WARNING):
        assert cache.load("office", [10, 11]).images.shape == (2, 3, *SMALL)
    assert sum("no longer written" in record.getMessage() for record in caplog.records) == 1
