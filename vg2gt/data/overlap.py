"""Checks between training and evaluation data, before the first step."""

from __future__ import annotations

import logging
from collections.abc import Sequence

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

    Scenes and places are compared by name, without the part of a mixture, so the two sources may be of different types.

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
    by_name: dict[str, list[str]] = {}
    by_place: dict[str, str] = {}
    for scene in scenes:
        by_name.setdefault(_without_part(train, scene, scene), []).append(scene)
        by_place.setdefault(_without_part(train, scene, train.place(scene)), scene)
    shared = 0
    for scene, frames in targets.items():
        same = by_name.get(_without_part(val, scene, scene), ())
        for seen in (frames - set(train.held_out(trained)) for trained in same):
            if seen:
                raise DataError(
                    f"scene {scene} is used for training and for evaluation: {len(seen)} of its evaluation frames are "
                    "not held out of training; give disjoint scenes, such as the lists that `vg2gt data splits` "
                    "writes, or hold frames out of training (data.holdout); if they are different scenes, rename one"
                )
        shared += bool(same)
        place = _without_part(val, scene, val.place(scene))
        if not same and place in by_place:
            raise DataError(
                f"evaluation scene {scene} and training scene {by_place[place]} show the same place ({place}): give "
                "disjoint scenes, such as the lists that `vg2gt data splits` writes; if they are different places, "
                "rename one"
            )
    if shared:
        log.info(
            "%d scenes are used for both training and evaluation; only frames held out of training are scored", shared
        )


def _without_part(source: SceneSource, scene: str, name: str) -> str:
    """Removes the prefix ``<part>/`` that a mixture adds to the name of a scene or place."""
    part = source.part(scene)
    return name.removeprefix(f"{part}/") if part else name
