"""Turns the views of a step into a batch: caches decoded frames in memory and replaces unreadable ones."""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch.utils.data import Dataset

from vg2gt.data.base import DataError, Frames, SceneSource, training_frames
from vg2gt.data.transforms import from_bytes, to_bytes
from vg2gt.data.views import SceneSample
from vg2gt.types import Batch, Cameras

log = logging.getLogger(__name__)


class FrameCache:
    """LRU cache of decoded and resized frames. Colour is stored as uint8, depth and cameras as they are.

    Args:
        source: dataset that frames are loaded from.
        prepare: resizes decoded frames before they are cached; all frames of a scene to one size.
        capacity: size of the cache in bytes.
    """

    def __init__(self, source: SceneSource, prepare: Callable[[Frames], Frames], capacity: int) -> None:
        self.source = source
        self.prepare = prepare
        self.capacity = capacity
        self._frames: OrderedDict[tuple[str, int], Frames] = OrderedDict()
        self._used = 0

    def load(self, scene: str, frame_ids: Sequence[int]) -> Frames:
        """Returns frames of a scene in the given order; decodes those that are not cached."""
        missing = [frame for frame in frame_ids if (scene, frame) not in self._frames]
        fresh = self._decode(scene, missing) if missing else {}
        chosen = [fresh[frame] if frame in fresh else self._frames[scene, frame] for frame in frame_ids]
        for frame, value in zip(frame_ids, chosen, strict=True):
            self._used += _size(value) if frame in fresh else 0
            self._frames[scene, frame] = value
            self._frames.move_to_end((scene, frame))
        while self._used > self.capacity:
            self._used -= _size(self._frames.popitem(last=False)[1])
        frames = Frames.concatenate(chosen)
        return replace(frames, images=from_bytes(frames.images))

    def _decode(self, scene: str, frame_ids: Sequence[int]) -> dict[int, Frames]:
        frames = self.prepare(self.source.load(scene, frame_ids))
        frames = replace(frames, images=to_bytes(frames.images))
        return {
            frame: frames.map(lambda tensor, row=row: tensor[row : row + 1].clone())  # [1, ...]
            for row, frame in enumerate(frame_ids)
        }


def _size(frames: Frames) -> int:
    return sum(value.nbytes for value in vars(frames).values() if isinstance(value, torch.Tensor))


class BatchDataset(Dataset[Batch]):
    """Dataset of batches, indexed by the tuples of views that ``StepSampler`` yields.

    Args:
        source: the scenes.
        prepare: resizes decoded frames to their final size before they are cached.
        memory_mb: size of the cache of decoded frames in each process, in MB.
        replace_damaged: replace an unreadable frame by the nearest readable one, with a warning (training); False
            raises an error (evaluation).
    """

    def __init__(
        self, source: SceneSource, prepare: Callable[[Frames], Frames], memory_mb: int, replace_damaged: bool = False
    ) -> None:
        self.source = source
        self.cache = FrameCache(source, prepare, memory_mb * 2**20)
        self.replace_damaged = replace_damaged
        self.damaged: set[tuple[str, int]] = set()

    def __getitem__(self, views: tuple[SceneSample, ...]) -> Batch:
        loaded = [self._load(view) for view in views]
        scenes = [frames for frames, _ in loaded]

        def stack(name: str) -> torch.Tensor:
            return torch.stack([getattr(scene, name) for scene in scenes])

        depth, mask = stack("depth"), None
        if any(scene.mask is not None for scene in scenes):
            mask = torch.stack([torch.ones_like(s.depth) if s.mask is None else s.mask for s in scenes])
            depth = torch.where(mask > 0.5, depth, 0.0)
        return Batch(
            images=stack("images"),
            depth=depth,
            cameras=Cameras(stack("world_to_camera"), stack("intrinsics"), (depth.shape[-2], depth.shape[-1])),
            frame_ids=torch.tensor([ids for _, ids in loaded], dtype=torch.int64),
            scene=tuple(view.scene for view in views),
            num_context=len(views[0].context),
            mask=mask,
        )

    def _load(self, view: SceneSample) -> tuple[Frames, Sequence[int]]:
        """Loads the frames of a scene with their ids, unreadable ones replaced.

        The result depends only on the files, not on what was read before.
        """
        ids = view.frames
        if not self.replace_damaged:
            return self.cache.load(view.scene, ids), ids
        if self.damaged.isdisjoint((view.scene, frame) for frame in ids):
            try:
                return self.cache.load(view.scene, ids), ids
            except DataError:
                pass  # _replace finds the damaged frame by reading one at a time
        ids = self._replace(view.scene, ids)
        return self.cache.load(view.scene, ids), ids

    def _replace(self, scene: str, ids: Sequence[int]) -> tuple[int, ...]:
        frames = training_frames(self.source, scene)
        chosen = list(ids)
        for place in [place for place, frame in enumerate(ids) if not self._reads(scene, frame)]:
            middle = frames.index(ids[place])
            nearest = sorted(range(len(frames)), key=lambda row, middle=middle: (abs(row - middle), row))
            taken = {*ids, *chosen}
            candidates = (frames[row] for row in nearest if frames[row] not in taken)
            found = next((frame for frame in candidates if self._reads(scene, frame)), None)
            if found is None:
                raise DataError(
                    f"scene {scene} has too few readable frames left for a sample of {len(ids)} views: restore its "
                    "files (the warnings name them) or remove the scene from the training scenes"
                )
            chosen[place] = found
        return tuple(chosen)

    def _reads(self, scene: str, frame: int) -> bool:
        if (scene, frame) in self.damaged:
            return False
        try:
            self.cache.load(scene, [frame])
        except DataError as error:
            self.damaged.add((scene, frame))
            log.warning(
                "cannot read frame %d of scene %s; training uses its nearest readable neighbour instead (unreadable "
                "frames in this process: %d): %s",
                frame, scene, len(self.damaged), error,
            )  # fmt: skip
            return False
        return True
