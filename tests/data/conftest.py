"""A small dataset on disk and small sources."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vg2gt.data import SyntheticScenes

SIZE = (24, 32)


@pytest.fixture(scope="session")
def rooms(tmp_path_factory) -> SyntheticScenes:
    """Four rooms of six small frames, cached for the session."""
    return SyntheticScenes(4, num_frames=6, size=SIZE, cache_dir=str(tmp_path_factory.mktemp("rooms")))


@pytest.fixture
def write_recording(tmp_path, rooms) -> Callable[..., Path]:
    """Returns a function that writes a room as an RGB-D recording with ``images/ depth/ poses.txt K.txt``."""

    def write(name: str = "office", scene: int = 0, frames: int = 6) -> Path:
        folder = tmp_path / name
        source = rooms.load(rooms.scenes[scene], range(frames))
        for sub in ("images", "depth"):
            (folder / sub).mkdir(parents=True)
        for i in range(frames):
            pixels = (source.images[i].permute(1, 2, 0).numpy() * 255 + 0.5).astype(np.uint8)
            Image.fromarray(pixels).save(folder / "images" / f"{i + 10:05d}.png")
            millimetres = (source.depth[i].numpy() * 1000 + 0.5).astype(np.uint16)
            Image.fromarray(millimetres).save(folder / "depth" / f"{i + 10:05d}.png")
        poses = np.linalg.inv(source.world_to_camera.double().numpy())
        np.savetxt(folder / "poses.txt", poses.reshape(-1, 16))
        np.savetxt(folder / "K.txt", source.intrinsics[0].numpy())
        return folder

    return write
