"""Evenly spaced input and target views for evaluation during training. Deterministic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from vg2gt.data.base import DataError, SceneSource
from vg2gt.data.views import SceneSample

Item = TypeVar("Item")


@dataclass(frozen=True)
class EvaluationViews:
    """Chooses context and target views of evaluation scenes.

    Args:
        context: positions of the input frames in the scene, or their number. A number of frames is spread evenly over
            the frames that are not held out.
        target: positions of the target frames, or their number. A number of frames is spread evenly over the source's
            held-out frames, or over all frames that are not context views if it holds none out.
        window: split long scenes into windows of about this many consecutive frames and evaluate each separately;
            None: the whole scene at once. Requires numbers, not positions, in ``context`` and ``target``.
    """

    context: int | Sequence[int] = 8
    target: int | Sequence[int] = 3
    window: int | None = None

    def __post_init__(self) -> None:
        if self.window is not None and not (isinstance(self.context, int) and isinstance(self.target, int)):
            raise ValueError("eval_window needs numbers of views in eval_context and eval_target, not positions")

    def choose(self, source: SceneSource, scene: str) -> list[SceneSample]:
        """Returns the evaluation samples of one scene.

        Raises:
            DataError: if a position is out of range, no frame is left for the context, or a frame is both context and
                target.
        """
        frames, held_out = list(source.frames(scene)), set(source.held_out(scene))
        if self.window is None:
            return [self._choose(scene, frames, held_out)]
        count = max(1, round(len(frames) / self.window))
        return [
            self._choose(scene, [frames[i] for i in part], held_out)
            for part in np.array_split(np.arange(len(frames)), count)
        ]

    def _choose(self, scene: str, frames: list[int], held_out: set[int]) -> SceneSample:
        if isinstance(self.context, int):
            context = spread([frame for frame in frames if frame not in held_out], self.context)
        else:
            context = _at(frames, self.context, scene, "eval_context")
        if isinstance(self.target, int):
            inputs, kept = set(context), [frame for frame in frames if frame in held_out]
            target = spread(kept or [frame for frame in frames if frame not in inputs], self.target)
        else:
            target = _at(frames, self.target, scene, "eval_target")
        if not context:
            raise DataError(f"scene {scene} has no frame left for the evaluation's context views (data.eval_context)")
        shared = set(context) & set(target)
        if shared:
            raise DataError(f"frames {sorted(shared)} of scene {scene} are both context and target views in evaluation")
        return SceneSample(scene, tuple(context), tuple(target))


def spread(items: list[Item], count: int) -> list[Item]:
    """Returns ``count`` evenly spaced items, both ends included; all of them if there are fewer."""
    if count >= len(items):
        return items
    if count == 0:
        return []
    places = np.linspace(0, len(items) - 1, count) if count > 1 else np.array([(len(items) - 1) / 2])
    return [items[int(place + 0.5)] for place in places]


def _at(frames: list[int], positions: Sequence[int], scene: str, name: str) -> list[int]:
    bad = [position for position in positions if not 0 <= position < len(frames)]
    if bad:
        raise DataError(f"data.{name} names positions {bad}, but scene {scene} has {len(frames)} frames")
    return [frames[position] for position in positions]
