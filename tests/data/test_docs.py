"""The example of docs/add-a-dataset.md: its loader reads what it says, and training takes it with its configuration."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.commands import run_python

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "docs" / "add-a-dataset.md").read_text()


def block(language: str) -> str:
    match = re.search(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)
    assert match
    return match.group(1)


@pytest.fixture
def example(tmp_path: Path, rooms) -> Path:
    """The example's class and configuration beside data in its layout."""
    (tmp_path / "my_pkg.py").write_text(block("python"))
    (tmp_path / "my_configs" / "data").mkdir(parents=True)
    (tmp_path / "my_configs" / "data" / "mine.yaml").write_text(block("yaml"))
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
    return tmp_path


def test_the_example_reads_its_layout(example: Path, rooms, monkeypatch) -> None:
    assert len(block("python").splitlines()) <= 40
    monkeypatch.syspath_prepend(str(example))
    from my_pkg import Mine  # pyright: ignore[reportMissingImports]

    source = Mine(str(example / "data"))
    loaded, expected = source.load("hall", [4, 0]), rooms.load("room-000001", [4, 0])
    torch.testing.assert_close(loaded.images, expected.images, atol=1e-6, rtol=0)
    assert torch.equal(loaded.depth, expected.depth)
    torch.testing.assert_close(loaded.world_to_camera, expected.world_to_camera, atol=1e-6, rtol=0)
    assert torch.equal(loaded.intrinsics, expected.intrinsics)


def test_the_example_trains(example: Path) -> None:
    small = ["data.image_size=[28,42]", "data.max_images=4", "trainer.accelerator=cpu", "callbacks.progress_bar=null"]
    small += ["debug=fast_dev_run", "trainer.enable_progress_bar=false"]
    code = "import sys; sys.path.insert(0, ''); import vg2gt.cli; vg2gt.cli.main()"
    arguments = ["train", "--config-dir", "my_configs", "data=mine", "data.root=data", *small]
    result = run_python(code, *arguments, folder=example)
    assert result.returncode == 0, result.stderr[-3000:]
