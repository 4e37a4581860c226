"""A small dataset on disk and small sources."""

from collections.abc import Callable
from pathlib import Path

import pytest

from vg2gt.data import SceneDataModule, SyntheticScenes

from .sources import layout_rgbd

SIZE = (24, 32)


def module_of(rooms: SyntheticScenes, **options) -> SceneDataModule:
    """Trains on the rooms and evaluates on two others, but for the options."""
    val = SyntheticScenes(2, first_seed=100, num_frames=6, size=SIZE, cache_dir=str(rooms.cache_dir))
    defaults = {
        "image_size": SIZE, "min_views": 2, "max_views": 3, "max_images": 4, "eval_context": [0, 2, 4],
        "eval_target": [1, 3], "steps_per_epoch": 4,
    }  # fmt: skip
    return SceneDataModule(**{"train": rooms, "val": val, **defaults, **options})


@pytest.fixture(scope="session")
def rooms(tmp_path_factory) -> SyntheticScenes:
    """Four rooms of six small frames, cached for the session."""
    return SyntheticScenes(4, num_frames=6, size=SIZE, cache_dir=str(tmp_path_factory.mktemp("rooms")))


@pytest.fixture
def write_recording(tmp_path, rooms) -> Callable[..., Path]:
    """Returns a function that writes a room as an RGB-D recording with ``images/ depth/ poses.txt K.txt``."""

    def write(name: str = "office", scene: int = 0, frames: int = 6) -> Path:
        return layout_rgbd.write_recording(tmp_path, rooms.load(rooms.scenes[scene], range(frames)), name)

    return write
