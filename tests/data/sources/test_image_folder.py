"""Folders of photographs: orientation, mixed sizes, order, and that nothing trains on them."""

from pathlib import Path
from shutil import copytree

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from PIL import Image

from examples.data_sets.image_folder import ImageFolder
from tests.commands import ROOT
from vg2gt.config import compose
from vg2gt.data import DataError

# Rows of an upright image with its top in red and its left in dark, for every EXIF orientation (standard table).
_STORED = {
    1: lambda upright: upright,
    2: np.fliplr,
    3: lambda upright: np.rot90(upright, 2),
    4: np.flipud,
    5: lambda upright: np.swapaxes(upright, 0, 1),
    6: lambda upright: np.rot90(upright, 1),
    7: lambda upright: np.swapaxes(np.rot90(upright, 2), 0, 1),
    8: lambda upright: np.rot90(upright, -1),
}


def _save(path: Path, pixels: np.ndarray, orientation: int | None = None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = Image.fromarray(np.ascontiguousarray(pixels))
    exif = Image.Exif()
    if orientation is not None:
        exif[0x0112] = orientation
    image.save(path, exif=exif)


def _photo(seed: int = 0, size: tuple[int, int] = (20, 30)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (*size, 3), np.uint8)


@pytest.mark.parametrize("orientation", _STORED)
def test_photos_are_turned_upright(tmp_path, orientation):
    upright = _photo()
    _save(tmp_path / "a.png", upright)
    _save(tmp_path / "b.png", _STORED[orientation](upright), orientation)
    source = ImageFolder(str(tmp_path))
    (scene,) = source.scenes
    assert source.scene_index(scene).color_size == (20, 30)
    frames = source.load(scene, [0, 1])
    assert torch.equal(frames.images[0], frames.images[1])


def test_order_sizes_and_placeholders(tmp_path):
    for i, name in enumerate(("IMG_10.png", "IMG_9.png", "IMG_009b.PNG", "notes.txt", ".hidden.png")):
        if name.endswith("txt"):
            (tmp_path / "trip" / name).write_text("no image")
        else:
            _save(tmp_path / "trip" / name, _photo(i, (20, 30) if i else (40, 50)))
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
        _save(tmp_path / "train" / f"{i}.png", _photo(i))
    copytree(tmp_path / "train", tmp_path / "val")
    plugin = f"hydra.searchpath=[{ROOT / 'examples/data_sets/configs'}]"
    overrides = [
        plugin,
        "data=image_folder",
        f"data.root={tmp_path}",
        "data.train.scenes=[train]",
        "data.val.scenes=[val]",
    ]
    module = instantiate(compose("train", *overrides, "data.index_cache=null").data)
    with pytest.raises(DataError, match="ImageFolder has no depth and no cameras"):
        module.train_dataloader()
