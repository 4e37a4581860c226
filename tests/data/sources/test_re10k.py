"""Chunks of pixelSplat (RealEstate10K, ACID) and its evaluation indices; as documented."""

import json
import pickle
from pathlib import Path

import pytest
import torch

from examples.data_sets.re10k import PixelSplatChunks
from vg2gt.data import DataError, Frames
from vg2gt.data.views.drawn import ViewSelection

from .layouts import encoded, pixels, room


def write_chunks(root: Path, frames: Frames, split: str = "test") -> None:
    """One chunk of two scenes."""
    height, width = frames.depth.shape[-2:]
    cameras = torch.zeros(len(frames.images), 18)
    k = frames.intrinsics
    cameras[:, 0], cameras[:, 1] = k[:, 0, 0] / width, k[:, 1, 1] / height
    cameras[:, 2], cameras[:, 3] = (k[:, 0, 2] + 0.5) / width, (k[:, 1, 2] + 0.5) / height
    cameras[:, 6:] = frames.world_to_camera[:, :3].flatten(1)
    images = [torch.frombuffer(bytearray(encoded(image)), dtype=torch.uint8) for image in pixels(frames)]
    scene = {"url": "https://video", "timestamps": torch.arange(len(images)), "cameras": cameras, "images": images}
    scenes = [{**scene, "key": key} for key in ("0a1b", "2c3d")]
    (root / split).mkdir(parents=True)
    torch.save(scenes, root / split / "000000.torch")
    (root / split / "index.json").write_text(json.dumps({scene["key"]: "000000.torch" for scene in scenes}))


def test_chunks_are_read(tmp_path: Path) -> None:
    frames = room()
    write_chunks(tmp_path, frames)
    source = PixelSplatChunks(str(tmp_path), "test", holdout=3)
    assert source.scenes == ("0a1b", "2c3d")
    assert list(source.frames("0a1b")) == list(range(6))
    assert source.held_out("2c3d") == [0, 3]
    assert not source.has_depth
    read = pickle.loads(pickle.dumps(source)).load("2c3d", [4, 1])
    torch.testing.assert_close(read.world_to_camera, frames.world_to_camera[[4, 1]])
    torch.testing.assert_close(read.intrinsics, frames.intrinsics[[4, 1]])
    assert (read.images - frames.images[[4, 1]]).abs().mean() < 0.02
    assert list(PixelSplatChunks(str(tmp_path), "test", ["2c3d"], every=4).frames("2c3d")) == [0, 4]


def test_what_is_wrong_is_named(tmp_path: Path) -> None:
    write_chunks(tmp_path, room(2))
    with pytest.raises(DataError, match=r"no index\.json in .*train"):
        PixelSplatChunks(str(tmp_path), "train")
    with pytest.raises(DataError, match="no scene 9z"):
        PixelSplatChunks(str(tmp_path), "test", ["9z"])
    with pytest.raises(DataError, match=r"data\.root"):
        PixelSplatChunks(None, "test")

    class Evil:
        def __reduce__(self):
            return (Path(tmp_path / "ran").touch, ())

    path = tmp_path / "test" / "000000.torch"
    for damage in (lambda: path.write_bytes(b"no chunk"), lambda: torch.save([Evil()], path)):
        damage()
        with pytest.raises(DataError, match=r"000000\.torch is damaged or not a chunk"):
            PixelSplatChunks(str(tmp_path), "test").frames("0a1b")
    assert not (tmp_path / "ran").exists()


def test_their_evaluation_index_chooses_the_views(tmp_path: Path) -> None:
    write_chunks(tmp_path, room())
    index = tmp_path / "evaluation_index_re10k.json"
    index.write_text(json.dumps({"0a1b": {"context": [0, 5], "target": [1, 2, 4], "overlap": "large"}, "2c3d": None}))
    source = PixelSplatChunks(str(tmp_path), "test")
    (views,) = ViewSelection(str(index)).choose(source, ["0a1b"], 2)
    assert (views.context, views.target) == ((0, 5), (1, 2, 4))
