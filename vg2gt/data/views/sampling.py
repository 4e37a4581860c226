"""Sampling of training scenes and frames, as a pure function of the seed and the step number.

No state is kept between steps. A resumed run therefore continues with the same samples as an uninterrupted one, and
the number of loader workers and their prefetching do not matter.
"""

from __future__ import annotations

import logging
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from math import gcd, lcm

import numpy as np
from torch.utils.data import Sampler

from vg2gt.data.base import DataError, SceneSource, training_frames
from vg2gt.data.views import SceneSample

log = logging.getLogger(__name__)

_VIEWS, _SCENES, _FRAMES, _BLOCKS = 0, 1, 2, 3  # independent random streams
_LONGEST_BLOCK = 100_000


@dataclass(frozen=True)
class ViewSampler:
    """Draws the scenes and views of a training step (paper, Implementation Details: 3 to 18 views).

    Args:
        min_views: minimum number of context views.
        max_views: maximum number of context views.
        max_images: context images per step and device, at least ``max_views``; a step with N views holds
            ``max_images // N`` scenes.
        expand_ratio: the views are drawn from a window of ``expand_ratio * N`` consecutive frames.
        target_views: number of held-out views drawn from the same window, in addition.
        seed: seeds every draw.
        view_sets: number of fixed view draws per scene, so that the outputs of a frozen backbone can be cached
            (``backends.cache``); None: new draws at every step.
    """

    min_views: int = 3
    max_views: int = 18
    max_images: int = 18
    expand_ratio: float = 2.0
    target_views: int = 0
    seed: int = 0
    view_sets: int | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.min_views <= self.max_views:
            raise ValueError(f"need 1 <= min_views <= max_views, got {self.min_views} and {self.max_views}")
        if self.target_views < 0 or self.expand_ratio < 1:
            raise ValueError(
                f"need target_views >= 0 and expand_ratio >= 1, got {self.target_views} and {self.expand_ratio}"
            )
        if self.view_sets is not None and self.view_sets < 1:
            raise ValueError(f"data.view_sets must be at least 1, or null for new draws, got {self.view_sets}")
        if self.max_images < self.max_views:
            raise ValueError(
                f"need max_images >= max_views, got {self.max_images} and {self.max_views}: the {self.max_views} views "
                "of a scene do not fit into a step; raise data.max_images, or lower data.max_views (and data.min_views)"
            )

    @property
    def frames_needed(self) -> int:
        """Minimum number of frames of a scene: enough for the largest step."""
        return self.max_views + self.target_views

    def num_views(self, step: int) -> int:
        """Returns the number of context views of a step, the same on every device."""
        return int(self._rng(_VIEWS, step).integers(self.min_views, self.max_views + 1))

    def num_scenes(self, step: int) -> int:
        """Returns the number of scenes per device in a step."""
        return self.max_images // self.num_views(step)

    def slots(self, step: int, rank: int = 0, world_size: int = 1) -> range:
        """Returns the places of a step's scenes in the infinite scene sequence (``ScenePool.scene``).

        Every step and device owns a fixed stretch of the sequence, long enough for a step with ``min_views`` views. A
        step with more views has fewer scenes and skips the rest of its stretch. All scenes are therefore drawn equally
        often if the number of views is fixed, and in expectation if it varies.
        """
        reserved = self.max_images // self.min_views
        first = (step * world_size + rank) * reserved
        return range(first, first + self.num_scenes(step))

    def views(self, step: int, scene: str, frames: Sequence[int], slot: int) -> SceneSample:
        """Draws the views of one scene: an anchor, then distinct frames from a window around it.

        Args:
            step: training step.
            scene: the scene's name.
            frames: ids of its frames in capture order, at least ``frames_needed``.
            slot: index of the scene within the step, over all devices.
        """
        rng = self._rng(_FRAMES, step, slot)
        if self.view_sets is not None:
            rng = self._rng(_FRAMES, zlib.crc32(scene.encode()), int(rng.integers(self.view_sets)))
        context = self.num_views(step)
        needed = context + self.target_views
        window = min(len(frames), max(needed, round(self.expand_ratio * context)))
        anchor = int(rng.integers(len(frames)))
        start = int(np.clip(anchor - window // 2, 0, len(frames) - window))
        others = np.delete(np.arange(start, start + window), anchor - start)
        chosen = [anchor, *rng.permutation(others)[: needed - 1]]
        ids = tuple(int(frames[index]) for index in chosen)
        return SceneSample(scene, ids[:context], ids[context:])

    def _rng(self, *key: int) -> np.random.Generator:
        return np.random.default_rng((self.seed, *key))


@dataclass(frozen=True)
class ScenePool:
    """Infinite shuffled sequence of scenes from one or several parts, with random access by place.

    The sequence consists of blocks of ``sum(shares)`` places. Every block holds ``shares[k]`` scenes of part k, in its
    own random order, so that whole blocks hold the parts in exactly these proportions. The scenes of a part come in
    shuffled passes, each scene once per pass.

    Attributes:
        parts: scene names of every part.
        shares: number of places of every part in a block.
        seed: seeds the order of blocks and passes.
    """

    parts: tuple[tuple[str, ...], ...]
    shares: tuple[int, ...] = (1,)
    seed: int = 0

    def scene(self, place: int) -> str:
        """Returns the scene at a place of the sequence."""
        block, inside = divmod(place, sum(self.shares))
        order = _block(self.seed, block, self.shares)
        part = int(order[inside])
        earlier = block * self.shares[part] + int(np.count_nonzero(order[:inside] == part))
        turn, rank = divmod(earlier, len(self.parts[part]))
        return self.parts[part][_permutation(self.seed, turn, len(self.parts[part]), part)[rank]]


@lru_cache(maxsize=64)
def _permutation(seed: int, turn: int, count: int, part: int) -> np.ndarray:
    key = (seed, _SCENES, turn, part) if part else (seed, _SCENES, turn)
    return np.random.default_rng(key).permutation(count)


@lru_cache(maxsize=4)
def _block(seed: int, block: int, shares: tuple[int, ...]) -> np.ndarray:
    parts = np.repeat(np.arange(len(shares)), shares)
    return np.random.default_rng((seed, _BLOCKS, block)).permutation(parts)


def _scene_pool(source: SceneSource, scenes: Sequence[str], seed: int = 0) -> ScenePool:
    """Returns the scene sequence of training, with the parts of a mixture in proportion to their weights.

    Args:
        source: the training scenes, which define the parts and their weights.
        scenes: names of the scenes to use; parts without any are left out.
        seed: seeds the sequence.
    """
    grouped: dict[str, list[str]] = {part: [] for part in source.parts()}
    for scene in scenes:
        grouped[source.part(scene)].append(scene)
    weights = {part: weight for part, weight in source.parts().items() if grouped[part]}
    return ScenePool(tuple(tuple(grouped[part]) for part in weights), shares(weights), seed)


def shares(weights: Mapping[str, float]) -> tuple[int, ...]:
    """Returns the smallest integers in the exact proportions of positive decimal weights.

    Raises:
        ValueError: if the weights have too many digits, so that the integers sum to more than 100 000.
    """
    exact = [Fraction(str(weight)) for weight in weights.values()]
    scale = lcm(*(weight.denominator for weight in exact))
    counts = [int(weight * scale) for weight in exact]
    counts = [count // gcd(*counts) for count in counts]
    if sum(counts) > _LONGEST_BLOCK:
        raise ValueError(f"give the weights {dict(weights)} with fewer digits, or as small whole numbers")
    return tuple(counts)


def usable_scenes(source: SceneSource, sampler: ViewSampler, limit: int | None) -> list[str]:
    """Returns the training scenes that have enough frames for every step.

    Logs how many scenes are too short, and warns about every scene that cannot be indexed.

    Args:
        source: the training scenes.
        sampler: defines the required number of frames.
        limit: use at most this many of the source's first scenes; None: all.

    Raises:
        DataError: if no scene is left, or none of some part of a mixture.
    """
    scenes = list(source.scenes)[:limit]
    lengths: dict[str, int] = {}
    for scene in scenes:
        try:
            lengths[scene] = len(training_frames(source, scene))
        except DataError as error:
            log.warning("training scene %s is left out: %s", scene, error)
    usable = [scene for scene, length in lengths.items() if length >= sampler.frames_needed]
    short, damaged = len(lengths) - len(usable), len(scenes) - len(lengths)
    for part in dict.fromkeys(source.part(scene) for scene in scenes):
        if any(source.part(scene) == part for scene in usable):
            continue
        inside = [length for scene, length in lengths.items() if source.part(scene) == part]
        where = f" of {part}" if part else ""
        unread = f" ({damaged} scenes cannot be read, see the warnings)" if damaged else ""
        raise DataError(
            f"none of {len(inside)} training scenes{where} has {sampler.frames_needed} frames (max_views + "
            f"target_views){unread}; the longest has {max(inside, default=0)} that are not held out: lower "
            f"data.max_views and data.min_views, or data.target_views (now {sampler.target_views}), or use longer "
            "scenes"
        )
    if short:
        log.warning(
            "%d of %d training scenes have fewer than %d frames and are not used",
            short, len(scenes), sampler.frames_needed,
        )  # fmt: skip
    return usable


@dataclass(eq=False)
class StepSampler(Sampler[tuple[SceneSample, ...]]):
    """Yields the views of one device's batch, step by step.

    Args:
        source: the training scenes.
        scenes: names of the scenes to use.
        views: draws the views.
        steps: steps per epoch.
        start_step: returns the number of the first step; called at the start of every iteration, which ends with the
            epoch that contains this step.
        rank: index of this device.
        world_size: number of devices.
    """

    source: SceneSource
    scenes: Sequence[str]
    views: ViewSampler
    steps: int
    start_step: Callable[[], int] = lambda: 0
    rank: int = 0
    world_size: int = 1

    def __post_init__(self) -> None:
        self.pool = _scene_pool(self.source, self.scenes, self.views.seed)

    def __len__(self) -> int:
        return self.steps

    def __iter__(self) -> Iterator[tuple[SceneSample, ...]]:
        start = self.start_step()
        for step in range(start, (start // self.steps + 1) * self.steps):
            yield self.step(step)

    def step(self, step: int) -> tuple[SceneSample, ...]:
        """Returns the views of one step: one entry per scene, all with the same number of views."""
        places = self.views.slots(step, self.rank, self.world_size)
        scenes = [self.pool.scene(place) for place in places]
        first = self.rank * len(scenes)
        return tuple(
            self.views.views(step, scene, training_frames(self.source, scene), first + number)
            for number, scene in enumerate(scenes)
        )
