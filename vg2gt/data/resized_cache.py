"""Decoded and reduced frames on a fast disk, each made once."""

from __future__ import annotations

import hashlib
import io
import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from vg2gt.data.base import DataError, Frames, SceneSource
from vg2gt.data.framing import FramingSampler
from vg2gt.data.transforms import from_bytes, to_bytes
from vg2gt.io.files import write_bytes
from vg2gt.io.npz import load_npz

log = logging.getLogger(__name__)

_VERSION = 1
_NAMES = ("image", "depth", "world_to_camera", "intrinsics")


class ResizedCache(SceneSource):
    """A source whose frames are kept on disk, made smaller until they just suffice for a framing.

    A frame is written when it is first asked for, uncompressed: 7 bytes a pixel, 0.7 MB at 224x448. Its place depends
    on the scene's identity (the dataset's files and the loader's options) and on the size and fit, so a changed
    dataset is decoded anew; a damaged file is made again. Loading from it gives what loading from the source and
    reducing would, colours rounded to 8 bits.

    Args:
        source: where frames come from.
        folder: where they are kept (``~`` is the home folder); several runs and processes may share it.
        framing: what frames are needed for; they are made as small as all that it draws allows.
    """

    def __init__(self, source: SceneSource, folder: str | Path, framing: FramingSampler) -> None:
        self.source = source
        self.folder = Path(folder).expanduser()
        self.framing = framing
        self.is_metric = source.is_metric
        self.has_depth = source.has_depth
        self.has_cameras = source.has_cameras
        self._folders: dict[str, Path] = {}
        self._writes = True

    @property
    def scenes(self) -> Sequence[str]:
        """The source's scenes."""
        return self.source.scenes

    def frames(self, scene: str) -> Sequence[int]:
        """The source's frames."""
        return self.source.frames(scene)

    def held_out(self, scene: str) -> Sequence[int]:
        """The source's held-out frames."""
        return self.source.held_out(scene)

    def place(self, scene: str) -> str:
        """The source's place."""
        return self.source.place(scene)

    def scene_is_metric(self, scene: str) -> bool:
        """Whether the scene is in metres."""
        return self.source.scene_is_metric(scene)

    def parts(self) -> Mapping[str, float]:
        """The source's parts."""
        return self.source.parts()

    def part(self, scene: str) -> str:
        """The scene's part."""
        return self.source.part(scene)

    def identity(self, scene: str) -> str:
        """The source's, and what decides the size."""
        return json.dumps([_VERSION, self.framing.largest, self.framing.fit, self.source.identity(scene)])

    def load(self, scene: str, frame_ids: Sequence[int]) -> Frames:
        """Reads frames from the folder; those that are not there are decoded and written."""
        parts = [self._load(scene, frame) for frame in frame_ids]
        return Frames(
            torch.stack([part.images for part in parts]),
            torch.stack([part.depth for part in parts]),
            torch.stack([part.world_to_camera for part in parts]),
            torch.stack([part.intrinsics for part in parts]),
            parts[0].sparse_depth,
        )

    def _load(self, scene: str, frame: int) -> Frames:
        """One frame, without the views' axis."""
        path = self._scene_folder(scene) / f"{frame}.npz"
        if path.is_file():
            try:
                return _read(path, scene)
            except DataError as error:
                log.warning("the resized frame %s is damaged and is made again: %s", path, error)
        frames = self.framing.reduce(self.source.load(scene, [frame]))
        made = Frames(
            from_bytes(to_bytes(frames.images[0])),
            frames.depth[0],
            frames.world_to_camera[0],
            frames.intrinsics[0],
            frames.sparse_depth,
        )
        self._write(path, made)
        return made

    def _scene_folder(self, scene: str) -> Path:
        if scene not in self._folders:
            digest = hashlib.sha256(self.identity(scene).encode()).hexdigest()
            self._folders[scene] = self.folder / digest[:2] / digest[2:24]
        return self._folders[scene]

    def _write(self, path: Path, frame: Frames) -> None:
        if not self._writes:
            return
        buffer = io.BytesIO()
        np.savez(
            buffer,
            image=to_bytes(frame.images).numpy(),
            depth=frame.depth.numpy(),
            world_to_camera=frame.world_to_camera.numpy(),
            intrinsics=frame.intrinsics.numpy(),
            sparse_depth=np.array(frame.sparse_depth),
        )
        try:
            write_bytes(path, buffer.getvalue())
        except OSError as error:
            self._writes = False
            log.warning("resized frames are no longer written to %s, frames are decoded anew: %s", self.folder, error)


def _read(path: Path, scene: str) -> Frames:
    arrays = load_npz(path, scene, (*_NAMES, "sparse_depth"))
    image, depth, pose, intrinsics = (torch.from_numpy(arrays[name]) for name in _NAMES)
    return Frames(from_bytes(image), depth, pose, intrinsics, bool(arrays["sparse_depth"]))
