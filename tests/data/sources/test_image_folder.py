"""Folders of photographs: mixed sizes, order, and that nothing trains on them."""

from shutil import copytree

import numpy as np
import pytest
import torch
from hydra.utils import instantiate

from examples.data_sets.image_folder import ImageFolder
from tests.commands import ROOT
from vg2gt.config import compose
from vg2gt.data import DataError

from .layouts import save


def _photo(seed: int = 0, size: tuple[int, int] = (20, 30)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (*size, 3), np.uint8)


def test_order_sizes_and_placeholders(tmp_path):
    for i, name in enumerate(("IMG_10.png", "IMG_9.png", "IMG_009b.PNG", "notes.txt", ".hidden.png")):
        if name.endswith("txt"):
            (tmp_path / "trip" / name).write_text("no image")
        else:
            save(tmp_path / "trip" / name, _photo(i, (20, 30) if i else (40, 50)))
    source = ImageFolder(str(tmp_path))
    assert source.scenes == ("trip",)
    index = source.scene_index("trip")
    assert [path.name for path in index.color] == ["IMG_9.png", "IMG_009b.PNG", "IMG_10.png"]
    assert (index.size, index.color_size) == ((20, 30), None)
    frames = source.load("trip", [0, 2])
    assert frames.images.shape == (2, 3, 20, 30)
    assert torch.equal(frames.world_to_camera, torch.eye(4).expand(2, 4, 4))
    assert not frames.depth.any()
    # A guess, but one of the image as it is now: the larger image was reduced to 24x30 and cropped to 20 rows.
    assert frames.intrinsics[:, 0].tolist() == [pytest.approx([1.2 * 30, 0, 14.5])] * 2
    assert frames.intrinsics[:, 1].tolist() == [pytest.approx([0, 1.2 * 30, 9.5])] * 2
    assert not any((source.has_cameras, source.has_depth, source.is_metric))


def test_training_is_refused(tmp_path):
    for i in range(12):
        save(tmp_path / "train" / f"{i}.png", _photo(i))
    copytree(tmp_path / "train", tmp_path / "val")
    where = [f"hydra.searchpath=[{ROOT / 'examples/data_sets/configs'}]", "data=image_folder", f"data.root={tmp_path}"]
    scenes = ["data.train.scenes=[train]", "data.val.scenes=[val]", "data.index_cache=null"]
    module = instantiate(compose("train", *where, *scenes).data)
    with pytest.raises(DataError, match="ImageFolder has no depth and no cameras"):
        module.train_dataloader()
