"""Scenes made in the background are those that would have been made, once, and never in the way."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
import torch

from vg2gt.data import SceneDataModule, SyntheticScenes
from vg2gt.data.ahead import ScenesAhead
from vg2gt.data.mixture import Mixture

SMALL = {"num_frames": 4, "size": (14, 28)}


def scenes(folder: Path | None, count: int = 3, first_seed: int = 0) -> SyntheticScenes:
    return SyntheticScenes(count, first_seed, cache_dir=str(folder) if folder else None, **SMALL)


class Slow(SyntheticScenes):
    """Notes who makes what; the background waits until it is let go on."""

    def __init__(self, folder: Path) -> None:
        super().__init__(3, cache_dir=str(folder), **SMALL)
        self.made: list[str] = []
        self.begun, self.go_on = threading.Event(), threading.Event()

    def prepare(self, scene: str) -> None:
        self.begun.set()
        assert self.go_on.wait(60)
        self.made.append(scene)


def test_scenes_made_ahead_are_those_that_loading_makes(tmp_path: Path) -> None:
    ahead, later = scenes(tmp_path), scenes(None)
    with ScenesAhead((ahead, name) for name in ahead.scenes) as made:
        for name in ahead.scenes:
            made.claim(ahead, name)
            got, expected = ahead.load(name, [0, 3]), later.load(name, [0, 3])
            assert torch.equal(got.images, expected.images)
            assert torch.equal(got.depth, expected.depth)


def test_prepare_keeps_a_scene_and_makes_it_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = scenes(tmp_path)
    name = source.scenes[1]
    Mixture({"rooms": source}, {"rooms": 1}).prepare(f"rooms/{name}")
    path = source.cache_file(name)
    assert path is not None
    assert path.is_file()
    monkeypatch.setattr(source, "_render", lambda *_, **__: pytest.fail("made again"))
    source.prepare(name)
    source.load(name, [0])


def test_without_a_cache_nothing_is_made_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    source = scenes(None)
    monkeypatch.setattr(source, "_render", lambda *_, **__: pytest.fail("made for nobody"))
    source.prepare(source.scenes[0])


def test_a_claimed_scene_is_not_made_and_one_in_the_making_is_waited_for(tmp_path: Path) -> None:
    source = Slow(tmp_path)
    first, second, third = source.scenes
    with ScenesAhead((source, name) for name in source.scenes) as made:
        assert source.begun.wait(60)
        made.claim(source, second)  # at once: nobody is at it
        claiming = threading.Thread(target=made.claim, args=(source, first))
        claiming.start()
        claiming.join(0.2)
        assert claiming.is_alive()
        source.go_on.set()
        claiming.join(60)
        assert not claiming.is_alive()
        assert source.made[0] == first
        made.claim(source, third)
    assert second not in source.made


def test_the_end_of_the_block_waits_for_one_scene_at_most(tmp_path: Path) -> None:
    source = Slow(tmp_path)
    with ScenesAhead((source, name) for name in source.scenes):
        assert source.begun.wait(60)
        threading.Timer(0.2, source.go_on.set).start()
    assert len(source.made) <= 1


def test_a_scene_that_cannot_be_made_does_not_stop_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = scenes(tmp_path)
    broken, *others = source.scenes
    make = source.prepare
    monkeypatch.setattr(source, "prepare", lambda name: make("no-such-scene" if name == broken else name))
    made = ScenesAhead((source, name) for name in source.scenes)
    made.__enter__()
    made._thread.join(60)  # not the block's end, which would take the others off the list
    files = [source.cache_file(name) for name in others]
    assert all(path is not None and path.is_file() for path in files)


def test_training_and_evaluation_scenes_are_made_ahead_in_order_of_use(tmp_path: Path) -> None:
    source, val = Slow(tmp_path), scenes(tmp_path, 2, first_seed=1000)
    source.go_on.set()
    data = SceneDataModule(
        source, val, image_size=(14, 28), min_views=2, max_views=2, max_images=2, eval_context=2, eval_target=1
    )
    data.setup("fit")
    with data.scenes_ahead(steps=2):
        assert data._train is not None
        assert data._train.ahead is not None
        data._train.ahead._thread.join(60)
    assert data._train.ahead is None
    expected = [batch.scene[0] for batch, _ in zip(data.train_dataloader(), range(2), strict=False)]
    assert source.made == list(dict.fromkeys(expected))
    assert all((path := val.cache_file(name)) is not None and path.is_file() for name in val.scenes)
