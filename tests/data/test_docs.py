"""The example of docs/add-a-dataset.md: its loader reads what it says, and its configuration makes batches."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra.utils import instantiate

from vg2gt.config import compose

from .sources.layouts import pixels, save

TEXT = (Path(__file__).resolve().parents[2] / "docs" / "add-a-dataset.md").read_text()


def block(language: str) -> str:
    return re.search(rf"```{language}\n(.*?)```", TEXT, re.DOTALL).group(1)


@pytest.fixture
def example(tmp_path: Path, rooms, monkeypatch) -> Path:
    """The example's class and configuration beside data in its layout."""
    (tmp_path / "my_pkg.py").write_text(block("python"))
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "my_configs" / "data").mkdir(parents=True)
    (tmp_path / "my_configs" / "data" / "mine.yaml").write_text(block("yaml"))
    frames = rooms.load("room-000001", range(6))
    folder = tmp_path / "data" / "hall"
    (folder / "depth").mkdir(parents=True)
    for i, image in enumerate(pixels(frames)):
        save(folder / "rgb" / f"{i}.png", image)
        np.save(folder / "depth" / f"{i}.npy", frames.depth[i].numpy())
    poses = np.linalg.inv(frames.world_to_camera.double().numpy())
    cameras = {"K": frames.intrinsics[0].tolist(), "poses": {str(i): pose.tolist() for i, pose in enumerate(poses)}}
    (folder / "cameras.json").write_text(json.dumps(cameras))
    return tmp_path


def test_the_example_reads_its_layout_and_makes_batches(example: Path, rooms) -> None:
    assert len(block("python").splitlines()) <= 40
    small = ["data.image_size=[28,42]", "data.max_images=4", f"data.root={example / 'data'}"]
    config = compose("train", f"hydra.searchpath=[{example / 'my_configs'}]", "data=mine", *small)
    module = instantiate(config.data)
    batch = next(iter(module.train_dataloader()))
    assert batch.images.shape[-3:] == (3, 28, 42)
    assert (batch.depth > 0).any()
    loaded, expected = module.train_source().load("hall", [4, 0]), rooms.load("room-000001", [4, 0])
    torch.testing.assert_close(loaded.images, expected.images, atol=1e-6, rtol=0)
    assert torch.equal(loaded.depth, expected.depth)
    torch.testing.assert_close(loaded.world_to_camera, expected.world_to_camera, atol=1e-6, rtol=0)
    assert torch.equal(loaded.intrinsics, expected.intrinsics)
