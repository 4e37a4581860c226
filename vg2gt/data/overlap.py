"""Checks between training and evaluation data, before the first step."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence

from vg2gt.data.base import DataError, SceneSource
from vg2gt.data.views import SceneSample

log = logging.getLogger(__name__)


def refuse_untrainable(source: SceneSource) -> None:
    """Raises if the training scenes have no cameras. Scenes without depth are allowed and train on colours only.

    Raises:
        DataError: if the source has no cameras.
    """
    if not source.has_cameras:
        lacking = "cameras" if source.has_depth else "depth and no cameras"
        raise DataError(
            f"{type(source).__name__} has no {lacking}: it can be used for reconstruction, but not for training; "
            "choose another dataset for data.train, such as a COLMAP model of the same photographs (data=colmap)"
        )
    if not source.has_depth:
        log.info(
            "%s has no depth: training uses the colours of held-out views and the consistency of rendered and decoded "
            "depth; loss terms that need ground-truth depth are zero",
            type(source).__name__,
        )


def refuse_overlap(
    train: SceneSource, scenes: Sequence[str], val: SceneSource, evaluation: Sequence[SceneSample]
) -> None:
    """Raises if evaluation targets are not held out of training, or if an evaluated place is also trained on.

    Training and evaluation scenes should be disjoint. If a scene is used for both, its evaluation targets must be
    held out of training; the number of such scenes is logged.

    Scenes and places are compared by name, so the two sources may be of different types. A part of a mixture is
    compared with the training part of the same name, or with all training data if there is none.

    Args:
        train: the training source.
        scenes: names of the scenes that are trained on.
        val: the evaluation source.
        evaluation: the evaluation samples.

    Raises:
        DataError: if an evaluation scene has targets (or, without targets, context views) that training does not hold
            out, or shows the same place as a training scene; the message names the first such scene.
    """
    targets: dict[str, set[int]] = {}
    for views in evaluation:
        targets.setdefault(views.scene, set()).update(views.target or views.context)
    by_name, by_place = _named(train, scenes, lambda scene: scene), _named(train, scenes, train.place)
    parts, shared = train.parts(), 0
    for scene, frames in targets.items():
        part = val.part(scene) if val.part(scene) in parts else None
        same = by_name.get((part, _without_part(val, scene, scene)), ())
        for trained in same:
            _refuse_seen_targets(train, trained, scene, frames)
        shared += bool(same)
        place = _without_part(val, scene, val.place(scene))
        if not same and (part, place) in by_place:
            raise DataError(
                f"evaluation scene {scene} and training scene {by_place[part, place][0]} show the same place "
                f"({place}): give disjoint scenes, such as the lists that `vg2gt data splits` writes; if "
                "they are different places, rename one"
            )
    if shared:
        log.info(
            "%d scenes are used for both training and evaluation; only frames held out of training are scored", shared
        )


def _named(
    source: SceneSource, scenes: Sequence[str], name: Callable[[str], str]
) -> Mapping[tuple[str | None, str], list[str]]:
    """Groups scenes by ``name(scene)``, under their part and under None, which stands for all parts."""
    found: dict[tuple[str | None, str], list[str]] = {}
    for scene in scenes:
        for part in (source.part(scene), None):
            found.setdefault((part, _without_part(source, scene, name(scene))), []).append(scene)
    return found


def _without_part(source: SceneSource, scene: str, name: str) -> str:
    """Removes the prefix ``<part>/`` that a mixture adds to the name of a scene or place."""
    part = source.part(scene)
    return name.removeprefix(f"{part}/") if part else name


def _refuse_seen_targets(train: SceneSource, trained: str, scene: str, frames: set[int]) -> None:
    seen = frames - set(train.held_out(trained))
    if seen:
        raise DataError(
            f"scene {scene} is used for training and for evaluation: {len(seen)} of its evaluation frames are not held "
            "out of training; give disjoint scenes, such as the lists that `vg2gt data splits` writes, or "
            "hold frames out of training (data.holdout); if they are different scenes, rename one"
        )
