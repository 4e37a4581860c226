"""Scenes in shards: tar files read by range, from a disk or from an object store."""

from __future__ import annotations

import io
import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import fsspec
import numpy as np
import torch
from fsspec.core import url_to_fs
from numpy.typing import NDArray
from PIL.Image import DecompressionBombError

from vg2gt.data.base import DataError, Frames, SceneSource
from vg2gt.data.sources.files import read_split
from vg2gt.data.transforms import from_bytes
from vg2gt.io.errors import FormatError
from vg2gt.io.images import color_image, open_image
from vg2gt.io.npz import read_npz

INDEX = "index.npz"
VERSION = 1
ARRAYS = ("frame_ids", "held_out", "shard", "image", "depth", "world_to_camera", "intrinsics")
# Where shards are read from: fsspec also knows addresses that lead on to others and run templates of their own.
SCHEMES = ("file", "local", "memory", "http", "https", "s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "adl", "hf")
# What Pillow raises for images that are damaged in one way or another; a FormatError is a ValueError.
_DAMAGED = (OSError, SyntaxError, ValueError, EOFError, KeyError, zlib.error, struct.error, DecompressionBombError)
_HEADERS = 4096  # bytes of an array's file beside its values, at most
_LARGEST = 1 << 30  # bytes of an encoded frame
_SHAPES = {"image": (2,), "depth": (2,), "world_to_camera": (4, 4), "intrinsics": (3, 3)}
_SCENE = {"rows": list, "place": str, "part": str, "is_metric": bool, "sparse_depth": bool, "identity": str}
_META = {"has_depth": bool, "has_cameras": bool, "parts": dict, "scenes": dict}


class ShardedScenes(SceneSource):
    """Scenes written by ``vg2gt data shards``.

    A frame is one range of one tar file, so frames are read in any order, and only those that are asked for: a step's
    views are a function of its number here as with files. Only the index (poses, intrinsics and offsets, about 150
    bytes per frame) is read at the start.

    Args:
        root: the folder of the shards, or its URL (``s3://``, ``gs://``, ``https://``, ...: those of ``SCHEMES`` that
            fsspec can open with the packages that are installed).
        subset: folder below ``root`` (``train`` or ``val``); None: ``root`` itself.
        scenes: names of the scenes to use, or a text file with one per line; None: all.
        weights: other weights of the parts than those of the mixture that was written; None: the same.
        storage_options: arguments of the file system, such as credentials.

    Raises:
        FileNotFoundError: if there is no index.
        DataError: if the index is damaged, a named scene or part does not exist, or the URL is of another kind.
    """

    def __init__(
        self,
        root: str | None,
        subset: str | None = None,
        scenes: Sequence[str] | str | None = None,
        weights: Mapping[str, float] | None = None,
        storage_options: Mapping[str, Any] | None = None,
    ) -> None:
        if not root:
            raise FileNotFoundError("data.root is not set: name the folder, or the URL, of shards")
        self.root = "/".join((str(root).rstrip("/"), *([subset] if subset else [])))
        self.storage_options = dict(storage_options or {})
        _check_address(self.root, self.storage_options)
        self._arrays, self._meta = self._read_index()
        self.is_metric = all(scene["is_metric"] for scene in self._meta["scenes"].values())
        self.has_depth = self._meta["has_depth"]
        self.has_cameras = self._meta["has_cameras"]
        self._weights = _weights(self._meta["parts"], weights)
        self._scenes = self._select(scenes)

    @property
    def scenes(self) -> Sequence[str]:
        """Names of the scenes, as the written source had them."""
        return self._scenes

    def frames(self, scene: str) -> Sequence[int]:
        """Ids of the frames that were written."""
        return self._column("frame_ids", scene).tolist()

    def held_out(self, scene: str) -> Sequence[int]:
        """Ids of the frames that the written source held out."""
        return self._column("frame_ids", scene)[self._column("held_out", scene)].tolist()

    def place(self, scene: str) -> str:
        """The place that the written source named."""
        return self._scene(scene)["place"]

    def scene_is_metric(self, scene: str) -> bool:
        """Whether the scene's unit is the metre."""
        return self._scene(scene)["is_metric"]

    def parts(self) -> Mapping[str, float]:
        """The parts of the mixture that was written."""
        return self._weights

    def part(self, scene: str) -> str:
        """The scene's part."""
        return self._scene(scene)["part"]

    def identity(self, scene: str) -> str:
        """The scene's own, when it was written, and how it was encoded."""
        return json.dumps([VERSION, self._meta["encoding"], self._scene(scene)["identity"]])

    def load(self, scene: str, frame_ids: Sequence[int]) -> Frames:
        """Reads the ranges of some frames, all at once, and decodes them.

        Raises:
            DataError: naming the shard, if it is missing or a frame in it is damaged.
        """
        rows = [self._row(scene, frame) for frame in frame_ids]
        names = [f"{self.root}/shard-{self._arrays['shard'][row]:06d}.tar" for row in rows]
        images, depths = self._arrays["image"][rows], self._arrays["depth"][rows]
        # A frame's depth stands right behind its image: one range holds both.
        system, _ = url_to_fs(self.root, **self.storage_options)
        paths = [system._strip_protocol(name) for name in names]
        ends = np.maximum(images.sum(1), depths.sum(1))
        try:
            ranges = system.cat_ranges(paths, images[:, 0].tolist(), ends.tolist(), on_error="raise")
        except (FileNotFoundError, ValueError) as error:
            raise DataError(f"cannot read shards of scene {scene} in {self.root}: {error}") from error
        decoded = [
            _decode(content, image, depth, f"frame {frame} of scene {scene} in {name}")
            for content, image, depth, frame, name in zip(ranges, images, depths, frame_ids, names, strict=True)
        ]
        return Frames(
            torch.stack([image for image, _ in decoded]),
            torch.stack([depth for _, depth in decoded]),
            torch.from_numpy(self._arrays["world_to_camera"][rows]),
            torch.from_numpy(self._arrays["intrinsics"][rows]),
            self._scene(scene)["sparse_depth"],
        )

    def _read_index(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        path = f"{self.root}/{INDEX}"
        try:
            with fsspec.open(path, "rb", **self.storage_options) as file:
                content = file.read()  # pyright: ignore[reportAttributeAccessIssue]
        except FileNotFoundError as error:
            raise FileNotFoundError(
                f"there are no shards in {self.root}: {INDEX} is missing; write them with vg2gt data shards"
            ) from error
        try:
            arrays = read_npz(io.BytesIO(content), ("meta", *ARRAYS))
            meta = json.loads(str(arrays.pop("meta")))
        except (FormatError, KeyError, ValueError, RecursionError) as error:
            raise DataError(f"{path} is damaged: {error}; write the shards again") from error
        version = meta.get("version") if isinstance(meta, dict) else None
        if version != VERSION:
            raise DataError(f"{path} is of version {version}, this program reads {VERSION}: write it again")
        if not (_arrays_fit(arrays) and _fits(meta, _META) and _scenes_fit(meta["scenes"], len(arrays["frame_ids"]))):
            raise DataError(f"{path} is damaged: its arrays and scenes do not fit together; write the shards again")
        return arrays, meta

    def _select(self, scenes: Sequence[str] | str | None) -> tuple[str, ...]:
        found = self._meta["scenes"]
        names = read_split(scenes) if isinstance(scenes, str) else list(found if scenes is None else scenes)
        unknown = [name for name in names if name not in found]
        if unknown:
            raise DataError(f"the shards in {self.root} hold no scene {unknown[0]}; their first is {next(iter(found))}")
        return tuple(names)

    def _scene(self, scene: str) -> dict[str, Any]:
        if scene not in self._meta["scenes"]:
            raise DataError(f"the shards in {self.root} hold no scene {scene}")
        return self._meta["scenes"][scene]

    def _column(self, name: str, scene: str) -> NDArray:
        first, end = self._scene(scene)["rows"]
        return self._arrays[name][first:end]

    def _row(self, scene: str, frame: int) -> int:
        ids = self._column("frame_ids", scene)
        places = np.flatnonzero(ids == frame)
        if not len(places):
            raise DataError(f"scene {scene} in {self.root} has no usable frame {frame}")
        return self._scene(scene)["rows"][0] + int(places[0])


def _arrays_fit(arrays: Mapping[str, NDArray]) -> bool:
    """Whether there is a row per frame of everything, and ranges are such as frames have."""
    rows = len(arrays["frame_ids"]) if arrays["frame_ids"].ndim else -1
    kinds = {"held_out": "b", "world_to_camera": "f", "intrinsics": "f"}
    if not all(
        array.shape == (rows, *_SHAPES.get(name, ())) and array.dtype.kind in kinds.get(name, "iu")
        for name, array in arrays.items()
    ):
        return False
    places = np.stack((arrays["image"], arrays["depth"])).astype(np.int64)
    span = np.abs(places[1, :, 0] - places[0, :, 0])
    lengths = places[..., 1]
    return bool(
        (arrays["shard"] >= 0).all()
        and (places >= 0).all()
        and max(lengths.max(initial=0), span.max(initial=0)) < _LARGEST
    )


def _scenes_fit(scenes: Mapping[str, Any], rows: int) -> bool:
    return all(
        _fits(scene, _SCENE)
        and len(scene["rows"]) == 2
        and all(isinstance(row, int) for row in scene["rows"])
        and 0 <= scene["rows"][0] < scene["rows"][1] <= rows
        for scene in scenes.values()
    )


def _fits(content: Any, kinds: Mapping[str, type]) -> bool:
    return isinstance(content, dict) and all(isinstance(content.get(name), kind) for name, kind in kinds.items())


def _check_address(root: str, storage_options: Mapping[str, Any]) -> None:
    scheme = root.partition("://")[0] if "://" in root else "file"
    if scheme not in SCHEMES or "::" in root or "protocol" in storage_options:
        raise DataError(f"shards are not read from {root!r}: give a folder, or a URL of {', '.join(SCHEMES)}")


def _weights(written: Mapping[str, float], chosen: Mapping[str, float] | None) -> dict[str, float]:
    if chosen is None:
        return dict(written)
    if set(chosen) != set(written) or not all(weight > 0 for weight in chosen.values()):
        raise DataError(f"the shards have parts {list(written)}: give each a weight above 0, not {dict(chosen)}")
    return dict(chosen)


def _decode(content: bytes, image: NDArray, depth: NDArray, where: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Decodes a frame from its range; ``image`` and ``depth`` are (offset, length) in the tar file."""
    start = int(image[0])
    encoded = (content[place - start : place - start + length] for place, length in (image.tolist(), depth.tolist()))
    try:
        pixels = np.array(color_image(open_image(io.BytesIO(next(encoded)))))
        limit = 4 * pixels.shape[0] * pixels.shape[1] + _HEADERS
        z = read_npz(io.BytesIO(next(encoded)), ("depth",), limit)["depth"]
    except _DAMAGED as error:
        raise DataError(f"cannot read {where}: {error}; copy the shard again, or write it again") from error
    if z.dtype != np.float32 or z.shape != pixels.shape[:2]:
        raise DataError(f"cannot read {where}: depth {z.dtype} {z.shape} does not fit the image {pixels.shape}")
    return from_bytes(torch.from_numpy(pixels)).permute(2, 0, 1).contiguous(), torch.from_numpy(z)
