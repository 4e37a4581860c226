"""Writes a dataset as a few large tar files, to be read by range from a disk or straight from an object store."""

from __future__ import annotations

import hashlib
import io
import json
import logging
import os
import runpy
import sys
import tarfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rich.progress import track
from torch.utils.data import DataLoader, Dataset

from vg2gt.data.base import DataError, SceneSource
from vg2gt.data.sharded_scenes import ARRAYS, INDEX, VERSION
from vg2gt.data.transforms import reduce_to_cover, to_bytes
from vg2gt.io.files import write_bytes

log = logging.getLogger(__name__)

_BLOCK = 512  # tar files are made of blocks of this many bytes


@dataclass(frozen=True)
class Encoding:
    """How frames are stored.

    Attributes:
        size: they are reduced until they just cover this size; None: as decoded.
        quality: JPEG quality of colour, 1 to 100; 0: PNG.
    """

    size: tuple[int, int] | None = None
    quality: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.quality <= 100 or (self.size is not None and (len(self.size) != 2 or min(self.size) < 1)):
            raise ValueError(f"need a quality in [0, 100] and a size [height, width], got {self.quality}, {self.size}")


@dataclass(frozen=True)
class _Encoded:
    """One frame as it is stored, or why it cannot be."""

    image: bytes
    depth: bytes
    world_to_camera: NDArray[np.float32]
    intrinsics: NDArray[np.float32]
    sparse_depth: bool


class _Encoder(Dataset):
    """Frames of a source, encoded; in place of a frame that cannot be read, the reason."""

    def __init__(self, source: SceneSource, frames: Sequence[tuple[str, int]], encoding: Encoding) -> None:
        self.source = source
        self.frames = frames
        self.encoding = encoding

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> _Encoded | str:
        scene, frame = self.frames[index]
        try:
            loaded = self.source.load(scene, [frame])
        except DataError as error:
            return str(error)
        if self.encoding.size:
            loaded = reduce_to_cover(loaded, self.encoding.size)
        picture = Image.fromarray(to_bytes(loaded.images[0]).permute(1, 2, 0).numpy())
        image, depth = io.BytesIO(), io.BytesIO()
        if self.encoding.quality:
            picture.save(image, "JPEG", quality=self.encoding.quality, subsampling=0)
        else:
            picture.save(image, "PNG", compress_level=4)
        np.savez_compressed(depth, depth=loaded.depth[0].numpy())
        pose, intrinsics = loaded.world_to_camera[0].numpy(), loaded.intrinsics[0].numpy()
        return _Encoded(image.getvalue(), depth.getvalue(), pose, intrinsics, loaded.sparse_depth)


class _TarFiles:
    """Tar files under temporary names until they are complete."""

    def __init__(self, folder: Path, limit: float) -> None:
        self.folder = folder
        self.limit = limit
        self.number = -1
        self._tar: tarfile.TarFile | None = None

    def add(self, members: dict[str, bytes]) -> list[tuple[int, int]]:
        """Adds files, all to one tar file; returns their (offset, length) in it."""
        if self._tar is None or self._tell() > self.limit:
            self.close()
            self.number += 1
            self._tar = tarfile.open(self._temporary, "w")  # noqa: SIM115
        places = []
        for name, content in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            self._tar.addfile(info, io.BytesIO(content))
            padded = -(-len(content) // _BLOCK) * _BLOCK
            places.append((self._tell() - padded, len(content)))
        return places

    def close(self) -> None:
        """Ends the current tar file and gives it its name."""
        if self._tar is not None:
            self._tar.close()
            os.replace(self._temporary, self.folder / f"shard-{self.number:06d}.tar")
            self._tar = None

    @property
    def _temporary(self) -> Path:
        return self.folder / f".shard-{self.number:06d}.tar.tmp"

    def _tell(self) -> int:
        assert self._tar is not None
        assert self._tar.fileobj is not None
        return self._tar.fileobj.tell()


def write_shards(
    source: SceneSource,
    out: Path,
    encoding: Encoding | None = None,
    shard_mb: float = 256,
    workers: int = 0,
    progress: bool = False,
) -> dict[str, int]:
    """Writes the usable frames of a source as tar files and, last of all, the index that makes them a dataset.

    Frames that cannot be read are left out with a warning, as are scenes that cannot be indexed.

    Returns:
        The numbers of ``scenes``, ``frames``, ``shards`` and of ``unreadable`` frames.

    Raises:
        FileExistsError: if ``out`` holds anything.
        DataError: if nothing can be read.
    """
    encoding = encoding or Encoding()
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FileExistsError(f"{out} is not empty: remove it or choose another out=FOLDER")
    out.mkdir(parents=True, exist_ok=True)
    frames = _all_frames(source)
    loader = DataLoader(_Encoder(source, frames, encoding), batch_size=None, num_workers=workers)
    files, columns, sparse = _TarFiles(out, shard_mb * 2**20), {name: [] for name in ARRAYS}, {}
    held_out = {scene: set(source.held_out(scene)) for scene in dict(frames)}
    written: list[str] = []
    suffix = "jpg" if encoding.quality else "png"
    for (scene, frame), item in zip(frames, track(loader, "frames", len(frames), disable=not progress), strict=True):
        if isinstance(item, str):
            log.warning("frame %d of scene %s is not written: %s", frame, scene, item)
            continue
        key = f"{scene}/{frame:08d}"
        image, depth = files.add({f"{key}.{suffix}": item.image, f"{key}.depth.npz": item.depth})
        held = frame in held_out[scene]
        row = (frame, held, files.number, image, depth, item.world_to_camera, item.intrinsics)
        for name, value in zip(ARRAYS, row, strict=True):
            columns[name].append(value)
        sparse[scene] = item.sparse_depth
        written.append(scene)
    files.close()
    if not written:
        raise DataError(f"none of {len(frames)} frames can be read, see the warnings: nothing is written to {out}")
    meta = _meta(source, written, sparse, encoding)
    write_bytes(out / INDEX, _index(columns, meta))
    counts = {"scenes": len(sparse), "frames": len(written), "shards": files.number + 1}
    return {**counts, "unreadable": len(frames) - len(written)}


def _all_frames(source: SceneSource) -> list[tuple[str, int]]:
    frames: list[tuple[str, int]] = []
    for scene in source.scenes:
        try:
            frames += [(scene, frame) for frame in source.frames(scene)]
        except DataError as error:
            log.warning("scene %s is not written: %s", scene, error)
    return frames


def _meta(source: SceneSource, written: Sequence[str], sparse: dict[str, bool], encoding: Encoding) -> dict[str, Any]:
    first = {scene: row for row, scene in reversed(list(enumerate(written)))}
    counts = Counter(written)
    scenes = {
        scene: {
            "rows": (first[scene], first[scene] + counts[scene]),
            "place": source.place(scene),
            "part": source.part(scene),
            "is_metric": source.scene_is_metric(scene),
            "sparse_depth": flag,
            "identity": hashlib.sha256(source.identity(scene).encode()).hexdigest(),
        }
        for scene, flag in sparse.items()
    }
    parts = {part: weight for part, weight in source.parts().items() if part in {s["part"] for s in scenes.values()}}
    return {
        "version": VERSION,
        "encoding": [encoding.size, encoding.quality],
        "has_depth": source.has_depth,
        "has_cameras": source.has_cameras,
        "parts": parts,
        "scenes": scenes,
    }


def _index(columns: dict[str, list], meta: dict[str, Any]) -> bytes:
    types = {"held_out": bool, "world_to_camera": np.float32, "intrinsics": np.float32}
    arrays = {name: np.array(values, types.get(name, np.int64)) for name, values in columns.items()}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, meta=np.array(json.dumps(meta)), **arrays)  # pyright: ignore[reportArgumentType]
    return buffer.getvalue()


if __name__ == "__main__":  # python -m vg2gt.data.shards, the same as vg2gt data shards
    sys.argv[1:1] = ["shards"]
    runpy.run_module("vg2gt.cli.data", run_name="__main__")
