"""Which scenes and frames a training step sees: a pure function of the seed and the step's number.

Nothing is remembered between steps, so a resumed run goes on with the samples that the uninterrupted run would have
seen, and the number of loader workers or their prefetching changes nothing.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from torch.utils.data import Sampler

from vg2gt.data.base import DataError, SceneSource, training_frames

log = logging.getLogger(__name__)

_VIEWS, _SCENES, _FRAMES = 0, 1, 2  # independent random streams


@dataclass(frozen=True)
class SceneViews:
    """Frames of one scene: the context views first, then the held-out target views.

    Attributes:
        scene: the scene's name.
        context: frame ids of the input views; the first is the anchor, whose camera becomes the world frame.
        target: frame ids of the held-out views, disjoint from ``context``.
    """

    scene: str
    context: tuple[int, ...]
    target: tuple[int, ...] = ()


@dataclass(frozen=True)
class ViewSampler:
    """Draws the scenes and views of a training step (paper, Implementation Details: 3 to 18 views).

    Args:
        min_views: fewest context views.
        max_views: most context views.
        max_images: context images in a step and on one device: a step with N views holds ``max_images // N`` scenes.
        expand_ratio: the views are drawn from a window of ``expand_ratio * N`` consecutive frames.
        target_views: held-out views drawn from the same window, in addition.
        seed: seeds every draw.
    """

    min_views: int = 3
    max_views: int = 18
    max_images: int = 18
    expand_ratio: float = 2.0
    target_views: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        if not 1 <= self.min_views <= self.max_views:
            raise ValueError(f"need 1 <= min_views <= max_views, got {self.min_views} and {self.max_views}")
        if self.target_views < 0 or self.expand_ratio < 1:
            raise ValueError(
                f"need target_views >= 0 and expand_ratio >= 1, got {self.target_views} and {self.expand_ratio}"
            )

    @property
    def frames_needed(self) -> int:
        """Frames a scene must have for every step to be able to use it."""
        return self.max_views + self.target_views

    def num_views(self, step: int) -> int:
        """Context views of a step, the same on every device."""
        return int(self._rng(_VIEWS, step).integers(self.min_views, self.max_views + 1))

    def num_scenes(self, step: int) -> int:
        """Scenes of a step on one device."""
        return max(1, self.max_images // self.num_views(step))

    def scene_indices(self, step: int, available: int, rank: int = 0, world_size: int = 1) -> list[int]:
        """Scenes of a step, as indices below ``available``.

        Every step and device owns a fixed stretch of an endless row of shuffled passes over the scenes, so all scenes
        come equally often.
        """
        reserved = max(1, self.max_images // self.min_views)
        first = (step * world_size + rank) * reserved
        slots = (divmod(slot, available) for slot in range(first, first + self.num_scenes(step)))
        return [int(_permutation(self.seed, turn, available)[place]) for turn, place in slots]

    def views(self, step: int, scene: str, frames: Sequence[int], slot: int) -> SceneViews:
        """Draws the views of one scene: an anchor, then distinct frames from a window around it.

        Args:
            step: number of the training step.
            scene: the scene's name.
            frames: ids of its frames in the order in which they were taken, at least ``frames_needed``.
            slot: number of the scene in the step over all devices.
        """
        rng = self._rng(_FRAMES, step, slot)
        context = self.num_views(step)
        needed = context + self.target_views
        window = min(len(frames), max(needed, round(self.expand_ratio * context)))
        anchor = int(rng.integers(len(frames)))
        start = int(np.clip(anchor - window // 2, 0, len(frames) - window))
        others = np.delete(np.arange(start, start + window), anchor - start)
        chosen = [anchor, *rng.permutation(others)[: needed - 1]]
        ids = tuple(int(frames[index]) for index in chosen)
        return SceneViews(scene, ids[:context], ids[context:])

    def _rng(self, *key: int) -> np.random.Generator:
        return np.random.default_rng((self.seed, *key))


@lru_cache(maxsize=4)
def _permutation(seed: int, turn: int, count: int) -> np.ndarray:
    return np.random.default_rng((seed, _SCENES, turn)).permutation(count)


def usable_scenes(source: SceneSource, sampler: ViewSampler, limit: int | None) -> list[str]:
    """Training scenes with enough frames for every step; the others are counted in a log line.

    Args:
        source: the training scenes.
        sampler: says how many frames are enough.
        limit: use at most this many of the source's first scenes; None: all.

    Raises:
        DataError: if none is left.
    """
    scenes = list(source.scenes)[:limit]
    usable = [scene for scene in scenes if len(training_frames(source, scene)) >= sampler.frames_needed]
    if not usable:
        longest = max((len(training_frames(source, scene)) for scene in scenes), default=0)
        possible = longest - sampler.target_views
        raise DataError(
            f"none of {len(scenes)} training scenes has {sampler.frames_needed} frames (max_views + target_views); the "
            f"longest has {longest} that are not held out: set data.max_views and data.min_views to at most {possible}"
        )
    if len(usable) < len(scenes):
        dropped = len(scenes) - len(usable)
        log.warning(
            "%d of %d training scenes have fewer than %d frames and are not used",
            dropped, len(scenes), sampler.frames_needed,
        )  # fmt: skip
    return usable


class StepSampler(Sampler[tuple[SceneViews, ...]]):
    """Yields, step after step, the views of one device's batch.

    Args:
        source: the training scenes.
        scenes: names of those that are used.
        views: draws scenes and views.
        steps: steps in an epoch.
        start_step: returns the number of the first step, asked whenever an iteration begins; the iteration ends with
            the epoch that holds this step.
        rank: number of this device.
        world_size: devices.
    """

    def __init__(
        self,
        source: SceneSource,
        scenes: Sequence[str],
        views: ViewSampler,
        steps: int,
        start_step: Callable[[], int] = lambda: 0,
        rank: int = 0,
        world_size: int = 1,
    ) -> None:
        self.source = source
        self.scenes = scenes
        self.views = views
        self.steps = steps
        self.start_step = start_step
        self.rank = rank
        self.world_size = world_size

    def __len__(self) -> int:
        return self.steps

    def __iter__(self) -> Iterator[tuple[SceneViews, ...]]:
        start = self.start_step()
        for step in range(start, (start // self.steps + 1) * self.steps):
            yield self.step(step)

    def step(self, step: int) -> tuple[SceneViews, ...]:
        """The views of one step, one entry a scene, all with equally many views."""
        indices = self.views.scene_indices(step, len(self.scenes), self.rank, self.world_size)
        first_slot = self.rank * len(indices)
        return tuple(
            self.views.views(step, scene, training_frames(self.source, scene), first_slot + place)
            for place, scene in enumerate(self.scenes[index] for index in indices)
        )
