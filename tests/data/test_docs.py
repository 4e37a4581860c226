"""examples/dataset.py reads its layout, and makes batches with its configuration (docs/guides/dataset.md)."""

import json
from pathlib import Path

import numpy as np
import torch
from hydra.utils import instantiate

from examples.dataset import Mine
from tests.commands import ROOT
from vg2gt.config import compose

from .sources.layouts import camera_to_world, pixels, save


def test_the_example_reads_its_layout_and_makes_batches(tmp_path: Path, rooms) -> None:
    frames, data = rooms.load("room-000001", range(6)), tmp_path / "data"
    folder = data / "hall"
    (folder / "depth").mkdir(parents=True)
    for i, image in enumerate(pixels(frames)):
        save(folder / "rgb" / f"{i}.png", image)
        np.save(folder / "depth" / f"{i}.npy", frames.depth[i].numpy())
    poses = {str(i): pose.tolist() for i, pose in enumerate(camera_to_world(frames))}
    cameras = {"K": frames.intrinsics[0].tolist(), "poses": poses}
    (folder / "cameras.json").write_text(json.dumps(cameras))
    loaded, expected = Mine(str(data)).load("hall", [4, 0]), frames.map(lambda tensor: tensor[[4, 0]])
    torch.testing.assert_close(loaded.images, expected.images, atol=1e-6, rtol=0)
    assert torch.equal(loaded.depth, expected.depth)
    torch.testing.assert_close(loaded.world_to_camera, expected.world_to_camera, atol=1e-6, rtol=0)
    assert torch.equal(loaded.intrinsics, expected.intrinsics)
    small = ["data=mine", f"data.root={data}", f"data.index_cache={tmp_path}", "data.image_size=[28,42]"]
    module = instantiate(compose("train", f"hydra.searchpath=[{ROOT / 'examples/configs'}]", *small).data)
    assert next(iter(module.train_dataloader())).images.shape[-2:] == (28, 42)
    assert next(iter(module.val_dataloader())).images.shape[-2:] == (28, 42)
