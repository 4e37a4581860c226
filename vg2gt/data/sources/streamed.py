"""Scenes in litdata streams: written once by ``vg2gt data stream``, read from a disk or from object storage.

Item 0 of a stream is a JSON description of its scenes, each other item a frame as safetensors. All items are bytes to
litdata, so that reading a stream executes nothing that it holds. Which frames are read is decided by the step number
alone (:mod:`vg2gt.data.views.sampling`), as for every other source; litdata fetches and keeps the chunks they are in.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from safetensors.torch import load, save

from vg2gt.data.base import DataError, Frames, SceneSource
from vg2gt.data.transforms import from_bytes, to_bytes

CHUNK = "64MB"
_TRAITS = ("is_metric", "has_depth", "dense_depth", "has_cameras")


class Streamed(SceneSource):
    """Scenes of a stream.

    Args:
        root: folder or address of the streams, such as ``s3://bucket/scans``.
        split: the stream in it, ``train`` or ``val``.

    Raises:
        DataError: if there is no stream, or litdata is missing.
    """

    def __init__(self, root: str | None, split: str = "train") -> None:
        if root is None:
            raise DataError("data.root must be the folder or address that vg2gt data stream wrote to")
        self.root = f"{os.path.expanduser(root).rstrip('/')}/{split}"
        header = json.loads(self._item(0))
        for name in _TRAITS:
            setattr(self, name, header[name])
        self._parts: dict[str, float] = header["parts"]
        self._scenes: dict[str, dict[str, Any]] = header["scenes"]
        ids = [(scene, frame) for scene, known in self._scenes.items() for frame in known["frames"]]
        self._rows = {key: row for row, key in enumerate(ids, start=1)}

    @property
    def scenes(self) -> Sequence[str]:
        """Names of the scenes."""
        return list(self._scenes)

    def frames(self, scene: str) -> Sequence[int]:
        """Ids of a scene's frames."""
        return self._scenes[scene]["frames"]

    def held_out(self, scene: str) -> Sequence[int]:
        """Ids of the frames that are kept for evaluation."""
        return self._scenes[scene]["held_out"]

    def place(self, scene: str) -> str:
        """Place that a scene shows."""
        return self._scenes[scene]["place"]

    def parts(self) -> dict[str, float]:
        """Sampling weight of every group of scenes."""
        return self._parts

    def part(self, scene: str) -> str:
        """Group of a scene."""
        return self._scenes[scene]["part"]

    def load(self, scene: str, frame_ids: Sequence[int]) -> Frames:
        """Reads frames."""
        return Frames.concatenate([_unpack(self._item(self._rows[scene, frame])) for frame in frame_ids])

    def _item(self, row: int) -> bytes:
        try:
            return bytes(_opened(self.root, os.getpid())[row])
        except ImportError as error:
            raise DataError(f"streams are read with litdata: pip install 'vg2gt[stream]' ({error})") from error
        except Exception as error:  # of litdata, or of the storage's client
            raise DataError(f"item {row} of the stream {self.root} cannot be read: {error}") from error


@lru_cache(maxsize=8)
def _opened(root: str, process: int) -> Any:
    """Opens a stream in this process: open files and threads do not survive a fork."""
    from litdata import StreamingDataset  # pyright: ignore[reportMissingImports]
    from litdata.streaming.serializers import _SERIALIZERS, BytesSerializer  # pyright: ignore[reportMissingImports]

    # Whatever a stream says its items are, they are taken as bytes and not unpickled. If this import breaks with a new
    # litdata: _SERIALIZERS maps names of kinds to serializers, and each of them is to be replaced.
    return StreamingDataset(root, serializers={name: BytesSerializer() for name in _SERIALIZERS})


def write_stream(
    source: SceneSource, scenes: Sequence[str], prepare: Callable[[Frames], Frames], out: str, workers: int = 1
) -> None:
    """Writes scenes as a stream.

    Args:
        source: where the frames come from.
        scenes: names of the scenes to write.
        prepare: resizes frames; all frames of a scene to one size.
        out: folder or address of the new stream.
        workers: number of processes.

    Raises:
        DataError: if litdata is missing, or a frame cannot be read.
    """
    try:
        from litdata import optimize  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise DataError(f"streams are written with litdata: pip install 'vg2gt[stream]' ({error})") from error
    packer = _Packer(source, tuple(scenes), prepare)
    optimize(
        packer, [-1, *range(len(scenes))], out, chunk_bytes=CHUNK, num_workers=workers, keep_data_ordered=True,
        mode="overwrite", reorder_files=False, verbose=False,
    )  # fmt: skip


@dataclass(frozen=True)
class _Packer:
    """Yields the description of the scenes (number -1), or a scene's frames."""

    source: SceneSource
    scenes: tuple[str, ...]
    prepare: Callable[[Frames], Frames]

    def __call__(self, number: int) -> Iterator[bytes]:
        source = self.source
        if number < 0:
            yield json.dumps(self._description()).encode()
            return
        scene = self.scenes[number]
        for frame in source.frames(scene):
            yield _pack(self.prepare(source.load(scene, [frame])))

    def _description(self) -> dict[str, Any]:
        source = self.source
        scenes = {
            scene: {
                "frames": list(source.frames(scene)),
                "held_out": list(source.held_out(scene)),
                "place": source.place(scene),
                "part": source.part(scene),
            }
            for scene in self.scenes
        }
        return {name: getattr(source, name) for name in _TRAITS} | {"parts": dict(source.parts()), "scenes": scenes}


def _pack(frames: Frames) -> bytes:
    """One frame as bytes; colour in 8 bits, as the data module keeps it."""
    tensors = {name: value for name, value in vars(frames).items() if isinstance(value, torch.Tensor)}
    tensors["images"] = to_bytes(frames.images)
    tensors["sparse_depth"] = torch.tensor(frames.sparse_depth)
    return save({name: value.contiguous() for name, value in tensors.items()})


def _unpack(item: bytes) -> Frames:
    tensors: dict[str, Any] = load(item)
    tensors["images"] = from_bytes(tensors["images"])
    tensors["sparse_depth"] = bool(tensors["sparse_depth"])
    return Frames(**tensors)
