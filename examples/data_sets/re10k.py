"""RealEstate10K and ACID in the chunk format of pixelSplat and its successors; DL3DV as converted by DepthSplat."""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from vg2gt.data.base import DataError, Frames, SceneSource
from vg2gt.data.sources.files import read_split
from vg2gt.data.transforms import from_bytes
from vg2gt.io.files import read_json, regular
from vg2gt.io.image_files import read_color


class PixelSplatChunks(SceneSource):
    """Posed video frames without depth; ``SPLIT/index.json`` maps each scene to a chunk ``SPLIT/NNNNNN.torch``.

    A chunk is a list of scenes with ``key``, ``images`` (encoded files as uint8 tensors) and ``cameras [V, 18]``: focal
    lengths and principal point relative to the image size, two zeros, and the rows of world-to-camera ``[3, 4]``. The
    id of a frame is its row. Chunks are loaded without running pickled code.

    Args:
        root: folder of the splits.
        split: ``train`` or ``test``.
        scenes: keys of scenes, or a text file of keys; None for all.
        every: use every N-th frame.
        holdout: hold out every N-th frame from training; None for none.

    Raises:
        DataError: if ``root`` is None, or the index or a named scene is missing.
    """

    is_metric = has_depth = dense_depth = False

    def __init__(
        self,
        root: str | None,
        split: str,
        scenes: Sequence[str] | str | None = None,
        every: int = 1,
        holdout: int | None = None,
    ) -> None:
        if root is None:
            raise DataError("data.root must be given: the folder that holds train/ and test/ with index.json")
        self.root, self.split, self.every, self.holdout = str(root), split, every, holdout
        folder = Path(root).expanduser() / split
        if not (folder / "index.json").is_file():
            raise DataError(f"no index.json in {folder}: expected {split}/index.json and {split}/*.torch in data.root")
        index = read_json(folder / "index.json")
        self._chunks = {str(key): folder / str(name) for key, name in index.items()}
        wanted = read_split(scenes) if isinstance(scenes, str) else scenes
        self._scenes = tuple(sorted(self._chunks) if wanted is None else wanted)
        if missing := [scene for scene in self._scenes if scene not in self._chunks]:
            raise DataError(f"{folder / 'index.json'} has no scene {', '.join(missing[:5])}")

    @property
    def scenes(self) -> Sequence[str]:
        """Returns the keys of the scenes."""
        return self._scenes

    def frames(self, scene: str) -> Sequence[int]:
        """Returns the ids of the scene's frames."""
        return range(0, len(self._entry(scene)["images"]), self.every)

    def held_out(self, scene: str) -> Sequence[int]:
        """Returns every ``holdout``-th frame."""
        return [] if self.holdout is None else list(self.frames(scene))[:: self.holdout]

    def load(self, scene: str, frame_ids: Sequence[int]) -> Frames:
        """Decodes frames; their depth is 0."""
        entry, path = self._entry(scene), self._chunks[scene]
        pixels = [read_color(path, scene, content=entry["images"][row].numpy().tobytes()) for row in frame_ids]
        if len({image.shape for image in pixels}) > 1:
            raise DataError(f"{path}: images of scene {scene} have several sizes")
        images = from_bytes(torch.stack([torch.from_numpy(image) for image in pixels])).permute(0, 3, 1, 2).contiguous()
        rows = entry["cameras"][list(frame_ids)].float()
        height, width = images.shape[-2:]
        intrinsics = torch.eye(3).repeat(len(rows), 1, 1)
        intrinsics[:, 0, 0], intrinsics[:, 1, 1] = rows[:, 0] * width, rows[:, 1] * height
        intrinsics[:, 0, 2], intrinsics[:, 1, 2] = rows[:, 2] * width - 0.5, rows[:, 3] * height - 0.5
        poses = torch.eye(4).repeat(len(rows), 1, 1)
        poses[:, :3] = rows[:, 6:].unflatten(1, (3, 4))
        return Frames(images, torch.zeros_like(images[:, 0]), poses, intrinsics)

    def _entry(self, scene: str) -> Mapping[str, Any]:
        path = self._chunks[scene]
        entry = _chunk(path).get(scene)
        if entry is None or entry["cameras"].shape != (len(entry["images"]), 18):
            raise DataError(f"{path} lacks scene {scene} with images and cameras [V, 18]")
        return entry


@lru_cache(maxsize=2)
def _chunk(path: Path) -> Mapping[str, Mapping[str, Any]]:
    try:
        content = torch.load(regular(path), map_location="cpu", weights_only=True, mmap=True)
        return {entry["key"]: {name: entry[name] for name in ("images", "cameras")} for entry in content}
    except (OSError, RuntimeError, KeyError, TypeError, ValueError, EOFError, pickle.UnpicklingError) as error:
        raise DataError(f"{path} is damaged or not a chunk of scenes: {str(error).splitlines()[0]}") from error
