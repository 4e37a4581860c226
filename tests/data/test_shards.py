"""Shards: the frames that were written, in any order, from a folder or another file system."""

import json
import logging
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from vg2gt.cli.data import data_module
from vg2gt.cli.data import shards as main
from vg2gt.data import DataError, Mixture, RGBDFolder, SceneDataModule, ShardedScenes, SyntheticScenes
from vg2gt.data.framing import FramingSampler
from vg2gt.data.sharded_scenes import INDEX
from vg2gt.data.shards import Encoding, write_shards
from vg2gt.data.transforms import reduce_to_cover

from .conftest import SIZE, assert_same_batches


@pytest.fixture
def mixture(write_recording, rooms) -> Mixture:
    recording = RGBDFolder(str(write_recording(frames=6)), holdout=3)
    return Mixture({"rooms": rooms, "office": recording}, {"rooms": 0.75, "office": 0.25})


def test_shards_hold_the_source(mixture, tmp_path):
    counts = write_shards(mixture, tmp_path / "out", shard_mb=0.01)
    assert counts["scenes"] == 5
    assert counts["frames"] == 30
    assert counts["unreadable"] == 0
    assert counts["shards"] == len(list((tmp_path / "out").glob("shard-*.tar"))) > 3
    shards = ShardedScenes(str(tmp_path / "out"))
    assert shards.scenes == mixture.scenes
    assert shards.parts() == mixture.parts()
    assert (shards.is_metric, shards.has_depth, shards.has_cameras) == (True, True, True)
    for scene in shards.scenes:
        for name in ("frames", "held_out"):
            assert list(getattr(shards, name)(scene)) == list(getattr(mixture, name)(scene))
        for name in ("place", "part", "scene_is_metric"):
            assert getattr(shards, name)(scene) == getattr(mixture, name)(scene)
        order = list(reversed(mixture.frames(scene)))[:4]
        loaded, expected = shards.load(scene, order), mixture.load(scene, order)
        assert float((loaded.images - expected.images).abs().max()) < 1e-6
        for name in ("depth", "world_to_camera", "intrinsics"):
            assert torch.equal(getattr(loaded, name), getattr(expected, name))
    assert len({shards.identity(scene) for scene in shards.scenes}) == 5


def test_frames_are_reduced_and_compressed(rooms, tmp_path):
    write_shards(rooms, tmp_path / "out", Encoding((12, 14), quality=95))
    loaded = ShardedScenes(str(tmp_path / "out")).load("room-000002", [5])
    expected = reduce_to_cover(rooms.load("room-000002", [5]), (12, 14))
    assert float((loaded.images - expected.images).abs().mean()) < 0.02
    assert torch.equal(loaded.depth, expected.depth)


@pytest.mark.parametrize(
    "drawn", [{}, {"aspect": [0.5, 1.0], "zoom": [1, 1.2], "size_multiple": 2}, {"fit": "pad", "image_size": (24, 48)}]
)
def test_training_reads_shards_in_workers_as_the_source_itself(mixture, tmp_path, drawn):
    write_shards(mixture, tmp_path / "out", Encoding(FramingSampler(**{"image_size": SIZE, **drawn}).largest))
    val = SyntheticScenes(1, first_seed=70, num_frames=4, size=SIZE)
    options: dict[str, Any] = {
        "image_size": SIZE, "min_views": 2, "max_views": 3, "max_images": 6, "steps_per_epoch": 6, "eval_context": [0],
        "eval_target": [1], **drawn,
    }  # fmt: skip
    direct = list(SceneDataModule(mixture, val, **options).train_dataloader())
    for workers in (0, 2):
        shards = ShardedScenes(str(tmp_path / "out"))
        assert_same_batches(SceneDataModule(shards, val, workers=workers, **options).train_dataloader(), direct)


def test_shards_are_read_from_other_file_systems(rooms, tmp_path):
    write_shards(rooms, tmp_path / "out")
    memory = fsspec.filesystem("memory")
    memory.put(str(tmp_path / "out"), "/bucket", recursive=True)
    try:
        shards = ShardedScenes("memory://bucket")
        expected = rooms.load("room-000001", [4, 2])
        assert torch.equal(shards.load("room-000001", [4, 2]).depth, expected.depth)
    finally:
        memory.rm("/bucket", recursive=True)


def test_webdataset_reads_the_shards(rooms, tmp_path):
    webdataset = pytest.importorskip("webdataset", reason="needs webdataset, whose format shards have")
    write_shards(rooms, tmp_path / "out")
    samples = list(webdataset.WebDataset(str(tmp_path / "out" / "shard-000000.tar"), shardshuffle=False).decode("rgb8"))
    assert len(samples) == 24
    assert samples[7]["__key__"] == "room-000001/00000001"
    expected = rooms.load("room-000001", [1])
    assert np.array_equal(samples[7]["png"], (expected.images[0].permute(1, 2, 0) * 255).round().numpy())
    assert np.array_equal(samples[7]["depth.npz"]["depth"], expected.depth[0].numpy())


def test_unreadable_frames_are_counted(write_recording, tmp_path, caplog):
    folder = write_recording(frames=4)
    image = folder / "images" / "00012.png"
    image.write_bytes(image.read_bytes()[:-200])
    with caplog.at_level(logging.WARNING):
        counts = write_shards(RGBDFolder(str(folder), holdout=None), tmp_path / "out")
    assert counts == {"scenes": 1, "frames": 3, "shards": 1, "unreadable": 1}
    assert "00012.png" in caplog.text
    assert list(ShardedScenes(str(tmp_path / "out")).frames("office")) == [10, 11, 13]


def test_damaged_shards_name_the_file(rooms, tmp_path):
    out = tmp_path / "out"
    write_shards(rooms, out)
    tar = out / "shard-000000.tar"
    content = tar.read_bytes()
    generator = np.random.default_rng(0)
    messages = []
    for _ in range(60):
        damaged = bytearray(content)
        for place in generator.integers(0, len(content), 40):
            damaged[place] ^= 1 << generator.integers(8)
        tar.write_bytes(damaged[: generator.integers(len(content))] if generator.random() < 0.3 else damaged)
        try:
            ShardedScenes(str(out)).load("room-000001", range(6))
        except DataError as error:
            messages.append(str(error))
    assert len(messages) > 20
    assert all("shard-000000.tar" in message for message in messages)
    tar.unlink()
    with pytest.raises(DataError, match=r"shard-000000\.tar"):
        ShardedScenes(str(out)).load("room-000001", [0])


@pytest.mark.parametrize("damage", [lambda c: c[:100], lambda c: b"", lambda c: c[:-50], lambda c: b"PK" + c[7:]])
def test_a_damaged_index_is_an_error(rooms, tmp_path, damage):
    write_shards(rooms, tmp_path / "out")
    path = tmp_path / "out" / INDEX
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(DataError, match=r"index\.npz is damaged"):
        ShardedScenes(str(tmp_path / "out"))


def test_scenes_and_weights_can_be_chosen(mixture, tmp_path):
    write_shards(mixture, tmp_path / "out")
    chosen = ShardedScenes(str(tmp_path / "out"), scenes=["office/office"])
    assert list(chosen.scenes) == ["office/office"]
    again = ShardedScenes(str(tmp_path / "out"), weights=OmegaConf.create({"rooms": 1, "office": 4}))
    assert again.parts() == {"rooms": 1, "office": 4}
    with pytest.raises(DataError, match="no scene hall"):
        ShardedScenes(str(tmp_path / "out"), scenes=["hall"])
    with pytest.raises(DataError, match="give each a weight"):
        ShardedScenes(str(tmp_path / "out"), weights={"rooms": 1})
    with pytest.raises(DataError, match="no usable frame 99"):
        chosen.load("office/office", [99])
    with pytest.raises(FileNotFoundError, match="vg2gt data shards"):
        ShardedScenes(str(tmp_path / "nowhere"))
    with pytest.raises(FileNotFoundError, match=r"data\.root"):
        ShardedScenes(None)


def test_the_command_writes_what_data_shards_reads(write_recording, tmp_path, capsys):
    home = tmp_path / "home"
    shutil.copytree(write_recording("one"), home / "one")
    shutil.copytree(write_recording("two"), home / "two")
    for subset, scene in (("train", "one"), ("val", "two")):
        own = [f"out={tmp_path / 'shards' / subset}", f"subset={subset}", "size=[14,20]", "quality=90", "shard_mb=1"]
        data = ["data=rgbd", f"data.root={home}", "data.holdout=null", f"data.{subset}.scenes=[{scene}]"]
        main([*own, *data])
        assert "1 scenes, 6 frames, 1 shards, 0 unreadable" in capsys.readouterr().out
        with pytest.raises(SystemExit, match="not empty"):
            main([*own, *data])
    small = ["data.image_size=[14,20]", "data.min_views=2", "data.max_views=2", "data.eval_context=2"]
    module = data_module(["data=shards", f"data.root={tmp_path / 'shards'}", *small])
    module.setup()
    assert Counter(name for batch in [next(iter(module.train_dataloader()))] for name in batch.scene) == {"one": 4}
    assert next(iter(module.val_dataloader())).scene == ("two",)
    assert not list((tmp_path / "shards").rglob("*.tmp"))
    with np.load(tmp_path / "shards" / "train" / INDEX) as stored:
        assert str(tmp_path) not in json.dumps(json.loads(str(stored["meta"])))
    with pytest.raises(SystemExit, match="subset"):
        main([f"out={tmp_path / 'x'}", "subset=test", *data])
    assert not Path(tmp_path / "x").exists()
