"""Decoded frames kept in memory, least recently used dropped first."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import replace

from vg2gt.data.base import Frames, SceneSource
from vg2gt.data.transforms import from_bytes, to_bytes


class FrameCache:
    """Loads prepared frames; colour is kept as uint8, depth and cameras as they are.

    Args:
        source: where frames come from.
        prepare: resizes decoded frames, all of a scene to one size, before they are kept.
        capacity: bytes kept.
    """

    def __init__(self, source: SceneSource, prepare: Callable[[Frames], Frames], capacity: int) -> None:
        self.source = source
        self.prepare = prepare
        self.capacity = capacity
        self._frames: OrderedDict[tuple[str, int], Frames] = OrderedDict()
        self._used = 0

    def load(self, scene: str, frame_ids: Sequence[int]) -> Frames:
        """Returns frames of a scene in the given order, decoding those that are not in memory."""
        missing = [frame for frame in frame_ids if (scene, frame) not in self._frames]
        fresh = self._decode(scene, missing) if missing else {}
        chosen = [fresh[frame] if frame in fresh else self._recall(scene, frame) for frame in frame_ids]
        for frame, value in fresh.items():
            self._keep((scene, frame), value)
        frames = Frames.concatenate(chosen)
        return replace(frames, images=from_bytes(frames.images))

    def _decode(self, scene: str, frame_ids: Sequence[int]) -> dict[int, Frames]:
        frames = self.prepare(self.source.load(scene, frame_ids))
        frames = replace(frames, images=to_bytes(frames.images))
        return {
            frame: frames.map(lambda tensor, row=row: tensor[row : row + 1].clone())  # [1, ...]
            for row, frame in enumerate(frame_ids)
        }

    def _recall(self, scene: str, frame: int) -> Frames:
        self._frames.move_to_end((scene, frame))
        return self._frames[scene, frame]

    def _keep(self, key: tuple[str, int], frames: Frames) -> None:
        self._frames[key] = frames
        self._used += _size(frames)
        while self._used > self.capacity:
            _, dropped = self._frames.popitem(last=False)
            self._used -= _size(dropped)


def _size(frames: Frames) -> int:
    mask = 0 if frames.mask is None else frames.mask.nbytes
    return mask + frames.images.nbytes + frames.depth.nbytes + frames.world_to_camera.nbytes + frames.intrinsics.nbytes
