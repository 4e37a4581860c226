"""examples/dataset.py reads its layout, and training takes it with its configuration (docs/guides/dataset.md)."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from examples.dataset import Mine
from tests.commands import ROOT, VG2GT, run_python


@pytest.fixture
def example(tmp_path: Path, rooms) -> Path:
    """A folder of one scene in the example's layout."""
    frames = rooms.load("room-000001", range(6))
    folder = tmp_path / "data" / "hall"
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    for i in range(6):
        pixels = (frames.images[i].permute(1, 2, 0).numpy() * 255 + 0.5).astype(np.uint8)
        Image.fromarray(pixels).save(folder / "rgb" / f"{i}.png")
        np.save(folder / "depth" / f"{i}.npy", frames.depth[i].numpy())
    poses = np.linalg.inv(frames.world_to_camera.double().numpy())
    cameras = {"K": frames.intrinsics[0].tolist(), "poses": {str(i): pose.tolist() for i, pose in enumerate(poses)}}
    (folder / "cameras.json").write_text(json.dumps(cameras))
    return tmp_path / "data"


def test_the_example_reads_its_layout(example: Path, rooms) -> None:
    source = Mine(str(example))
    loaded, expected = source.load("hall", [4, 0]), rooms.load("room-000001", [4, 0])
    torch.testing.assert_close(loaded.images, expected.images, atol=1e-6, rtol=0)
    assert torch.equal(loaded.depth, expected.depth)
    torch.testing.assert_close(loaded.world_to_camera, expected.world_to_camera, atol=1e-6, rtol=0)
    assert torch.equal(loaded.intrinsics, expected.intrinsics)


def test_the_example_trains(example: Path) -> None:
    small = ["data.image_size=[28,42]", "data.max_images=4", "trainer.accelerator=cpu", "callbacks.progress_bar=null"]
    small += ["debug=fast_dev_run", "trainer.enable_progress_bar=false"]
    arguments = ["train", "--config-dir", str(ROOT / "examples/configs"), "data=mine", f"data.root={example}", *small]
    result = run_python(VG2GT, *arguments, folder=example.parent)
    assert result.returncode == 0, result.stderr[-3000:]
