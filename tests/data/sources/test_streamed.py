"""Streams give the batches of the folders that they were written from, also after a resume and on two processes."""

import importlib.util
import json
import shutil
from functools import partial
from pathlib import Path

import pytest
import torch
from torch.utils.data import DataLoader

from vg2gt.data import DataError, RGBDFolder, SceneSource, SyntheticScenes
from vg2gt.data.batches import BatchDataset
from vg2gt.data.sources import Streamed
from vg2gt.data.sources.streamed import write_stream
from vg2gt.data.transforms import resize_to_cover
from vg2gt.data.views.sampling import StepSampler, ViewSampler
from vg2gt.types import Batch

from .layout_rgbd import write_recording

if importlib.util.find_spec("litdata") is None:
    pytest.skip("needs litdata: pip install 'vg2gt[stream]'", allow_module_level=True)

PREPARE = partial(resize_to_cover, size=(28, 42))
VIEWS = ViewSampler(2, 3, max_images=6, target_views=1, seed=3)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[RGBDFolder, Path]:
    """Three recordings, and the folder of the stream that was written from them."""
    folder = tmp_path_factory.mktemp("streams")
    rendered = SyntheticScenes(3, num_frames=7, size=(42, 56), cache_dir=str(folder / "cache"))
    for scene in rendered.scenes:
        write_recording(folder / "recordings", rendered.load(scene, range(7)), scene)
    source = RGBDFolder(str(folder / "recordings"), holdout=4)
    write_stream(source, source.scenes, PREPARE, str(folder / "out" / "train"))
    return source, folder / "out"


def batches(source: SceneSource, start: int, rank: int, world_size: int, workers: int = 0) -> list[Batch]:
    """The batches of steps ``start`` to 5."""
    sampler = StepSampler(source, source.scenes, VIEWS, 6, lambda: start, rank, world_size)
    data = BatchDataset(source, PREPARE, memory_mb=0, replace_damaged=True)
    return list(DataLoader(data, batch_size=None, sampler=sampler, num_workers=workers))  # pyright: ignore[reportArgumentType]


def assert_equal(found: list[Batch], expected: list[Batch]) -> None:
    assert len(found) == len(expected) > 0
    for one, other in zip(found, expected, strict=True):
        assert one.scene == other.scene
        for name in ("images", "depth", "frame_ids"):
            assert torch.equal(getattr(one, name), getattr(other, name)), name
        assert torch.equal(one.cameras.world_to_camera, other.cameras.world_to_camera)
        assert torch.equal(one.cameras.intrinsics, other.cameras.intrinsics)


def test_a_stream_is_the_folder_that_it_was_written_from(folders) -> None:
    source, out = folders
    stream = Streamed(str(out))
    assert stream.scenes == list(source.scenes)
    for scene in source.scenes:
        assert list(stream.frames(scene)) == list(source.frames(scene))
        assert list(stream.held_out(scene)) == list(source.held_out(scene)) != []
        for question in ("place", "part"):
            assert getattr(stream, question)(scene) == getattr(source, question)(scene), question
    assert stream.parts() == source.parts()
    assert_equal(batches(stream, 0, 0, 1), batches(source, 0, 0, 1))


@pytest.mark.parametrize(("ranks", "workers"), [(1, 0), pytest.param(2, 2, marks=pytest.mark.slow)])
def test_a_resumed_run_gets_the_same_batches(folders, ranks: int, workers: int) -> None:
    whole = [batches(Streamed(str(folders[1])), 0, rank, ranks) for rank in range(ranks)]
    assert not torch.equal(whole[0][0].images[0, 0], whole[0][1].images[0, 0])
    for rank in range(ranks):
        resumed = batches(Streamed(str(folders[1])), 3, rank, ranks, workers)
        assert_equal(resumed, whole[rank][3:])


def test_nothing_in_a_stream_is_unpickled(folders, tmp_path: Path) -> None:
    shutil.copytree(folders[1] / "train", tmp_path / "train")
    index = json.loads((tmp_path / "train" / "index.json").read_text())
    assert index["config"]["data_format"] == ["bytes"]
    index["config"]["data_format"] = ["pickle"]
    (tmp_path / "train" / "index.json").write_text(json.dumps(index))
    assert Streamed(str(tmp_path)).scenes == list(folders[0].scenes)


def test_a_missing_stream_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="nowhere/val"):
        Streamed(str(tmp_path / "nowhere"), "val")
    with pytest.raises(DataError, match=r"data\.root"):
        Streamed(None)
