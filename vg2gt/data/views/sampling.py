"""Which scenes and frames a training step sees: a pure function of the seed and the step's number.

Nothing is remembered between steps, so a resumed run goes on with the samples that the uninterrupted run would have
seen, and the number of loader workers or their prefetching changes nothing.
"""

from __future__ import annotations

import logging
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache
from math import gcd, lcm

import numpy as np
from torch.utils.data import Sampler

from vg2gt.data.base import DataError, SceneSource, training_frames
from vg2gt.data.framing import FramingSampler
from vg2gt.data.views import SceneSample

log = logging.getLogger(__name__)

_VIEWS, _SCENES, _FRAMES, _BLOCKS = 0, 1, 2, 3  # independent random streams
_LONGEST_BLOCK = 100_000


@dataclass(frozen=True)
class ViewSampler:
    """Draws the scenes and views of a training step (paper, Implementation Details: 3 to 18 views).

    Args:
        min_views: fewest context views.
        max_views: most context views.
        max_images: context images in a step and on one device: a step with N views holds ``max_images // N`` scenes;
            at least ``max_views``.
        expand_ratio: the views are drawn from a window of ``expand_ratio * N`` consecutive frames.
        target_views: held-out views drawn from the same window, in addition.
        seed: seeds every draw.
        view_sets: every scene's views come from this many fixed draws, so that what a frozen backbone makes of them
            can be kept (``backends.cache``); None draws again at every step.
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
        """Frames a scene must have for every step to be able to use it."""
        return self.max_views + self.target_views

    def num_views(self, step: int) -> int:
        """Context views of a step, the same on every device."""
        return int(self._rng(_VIEWS, step).integers(self.min_views, self.max_views + 1))

    def num_scenes(self, step: int) -> int:
        """Scenes of a step on one device."""
        return self.max_images // self.num_views(step)

    def slots(self, step: int, rank: int = 0, world_size: int = 1) -> range:
        """A step's places in the endless row of scenes (``ScenePool.scene``), one for each of its scenes.

        Every step and device owns a fixed stretch of the row, long enough for a step of ``min_views``; one of more
        views leaves the rest of its stretch out. So where the number of views is fixed, all scenes come equally often;
        where it varies, they do in expectation.
        """
        reserved = self.max_images // self.min_views
        first = (step * world_size + rank) * reserved
        return range(first, first + self.num_scenes(step))

    def views(self, step: int, scene: str, frames: Sequence[int], slot: int) -> SceneSample:
        """Draws the views of one scene: an anchor, then distinct frames from a window around it.

        Args:
            step: number of the training step.
            scene: the scene's name.
            frames: ids of its frames in the order in which they were taken, at least ``frames_needed``.
            slot: number of the scene in the step over all devices.
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
    """An endless row of scenes from one or several parts; what is at a place is a function of seed and place.

    The row is cut into blocks of ``sum(shares)`` places. Every block holds ``shares[k]`` scenes of part k in an order
    of its own, so any stretch of whole blocks holds the parts exactly in their shares. The scenes of a part come in
    shuffled passes, each scene once in a pass.

    Attributes:
        parts: scene names of every part.
        shares: places of every part in a block.
        seed: seeds both orders.
    """

    parts: tuple[tuple[str, ...], ...]
    shares: tuple[int, ...] = (1,)
    seed: int = 0

    def scene(self, place: int) -> str:
        """The scene at a place of the row."""
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


def scene_pool(source: SceneSource, scenes: Sequence[str], seed: int = 0) -> ScenePool:
    """The row from which training draws: one part, or a mixture's parts in proportion to their weights.

    Args:
        source: the training scenes; says which parts there are and what they weigh.
        scenes: names of those that are used; parts without any have no place in the row.
        seed: seeds the row.
    """
    grouped: dict[str, list[str]] = {part: [] for part in source.parts()}
    for scene in scenes:
        grouped[source.part(scene)].append(scene)
    weights = {part: weight for part, weight in source.parts().items() if grouped[part]}
    if len(weights) < len(grouped):
        absent = ", ".join(part for part in grouped if part not in weights)
        log.warning("no training scene of %s is used: the other parts are drawn in proportion to their weights", absent)
    return ScenePool(tuple(tuple(grouped[part]) for part in weights), shares(weights), seed)


def shares(weights: Mapping[str, float]) -> tuple[int, ...]:
    """The smallest whole numbers in exactly the proportions of positive decimal weights.

    Raises:
        ValueError: if the weights have so many digits that the numbers become huge.
    """
    exact = [Fraction(str(weight)) for weight in weights.values()]
    scale = lcm(*(weight.denominator for weight in exact))
    counts = [int(weight * scale) for weight in exact]
    counts = [count // gcd(*counts) for count in counts]
    if sum(counts) > _LONGEST_BLOCK:
        raise ValueError(f"give the weights {dict(weights)} with fewer digits, or as small whole numbers")
    return tuple(counts)


def usable_scenes(source: SceneSource, sampler: ViewSampler, limit: int | None) -> list[str]:
    """Training scenes with enough frames for every step; the others are counted in a log line.

    A scene that cannot be indexed is left out with a warning that names it.

    Args:
        source: the training scenes.
        sampler: says how many frames are enough.
        limit: use at most this many of the source's first scenes; None: all.

    Raises:
        DataError: if none is left, or none of a mixture's part.
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
        if not any(source.part(scene) == part for scene in usable):
            raise _nothing_usable(source, part, lengths, sampler, damaged)
    if short:
        log.warning(
            "%d of %d training scenes have fewer than %d frames and are not used",
            short, len(scenes), sampler.frames_needed,
        )  # fmt: skip
    if damaged:
        log.warning("%d of %d training scenes cannot be read and are not used", damaged, len(scenes))
    return usable


def _nothing_usable(
    source: SceneSource, part: str, lengths: Mapping[str, int], sampler: ViewSampler, damaged: int
) -> DataError:
    inside = [length for scene, length in lengths.items() if source.part(scene) == part]
    where = f" of {part}" if part else ""
    unread = f" ({damaged} scenes cannot be read, see the warnings)" if damaged else ""
    longest = max(inside, default=0)
    views = longest - sampler.target_views
    if views >= 1:
        remedy = f"set data.max_views and data.min_views to at most {views}, or lower data.target_views"
    elif longest > 1 and sampler.target_views:
        remedy = f"lower data.target_views (now {sampler.target_views}), and data.max_views and data.min_views with it"
    else:
        remedy = "use longer scenes, or hold fewer frames out (data.holdout)"
    return DataError(
        f"none of {len(inside)} training scenes{where} has {sampler.frames_needed} frames (max_views + target_views)"
        f"{unread}; the longest has {longest} that are not held out: {remedy}"
    )


@dataclass(eq=False)
class StepSampler(Sampler[tuple[SceneSample, ...]]):
    """Yields, step after step, the views of one device's batch, and how they are framed.

    Args:
        source: the training scenes.
        scenes: names of those that are used.
        views: draws the views.
        steps: steps in an epoch.
        start_step: returns the number of the first step, asked whenever an iteration begins; the iteration ends with
            the epoch that holds this step.
        rank: number of this device.
        world_size: devices.
        framing: draws sizes and crops; None: nothing is drawn.
    """

    source: SceneSource
    scenes: Sequence[str]
    views: ViewSampler
    steps: int
    start_step: Callable[[], int] = lambda: 0
    rank: int = 0
    world_size: int = 1
    framing: FramingSampler | None = None

    def __post_init__(self) -> None:
        self.pool = scene_pool(self.source, self.scenes, self.views.seed)

    def __len__(self) -> int:
        return self.steps

    def __iter__(self) -> Iterator[tuple[SceneSample, ...]]:
        start = self.start_step()
        for step in range(start, (start // self.steps + 1) * self.steps):
            yield self.step(step)

    def step(self, step: int) -> tuple[SceneSample, ...]:
        """The views of one step, one entry per scene, all with equally many views."""
        places = self.views.slots(step, self.rank, self.world_size)
        scenes = [self.pool.scene(place) for place in places]
        first = self.rank * len(scenes)
        return tuple(self._scene(step, scene, first + number) for number, scene in enumerate(scenes))

    def _scene(self, step: int, scene: str, slot: int) -> SceneSample:
        views = self.views.views(step, scene, training_frames(self.source, scene), slot)
        return replace(views, framing=self.framing.draw(step, slot)) if self.framing else views
