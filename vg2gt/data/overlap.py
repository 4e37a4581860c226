"""Checks between training and evaluation data, before the first step."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from vg2gt.data.base import DataError, SceneSource, training_frames
from vg2gt.data.sampling import SceneViews

log = logging.getLogger(__name__)


def refuse_untrainable(source: SceneSource) -> None:
    """Refuses to train on scenes without depth or cameras, which the losses compare with.

    Raises:
        DataError: saying what the source lacks.
    """
    lacking = [name for name, there in (("depth", source.has_depth), ("cameras", source.has_cameras)) if not there]
    if lacking:
        raise DataError(
            f"{type(source).__name__} has no {' and no '.join(lacking)}: it serves reconstruction and cannot be "
            "trained on; choose another dataset for data.train, or the loader's depth option"
        )


def refuse_overlap(
    train: SceneSource, scenes: Sequence[str], val: SceneSource, evaluation: Sequence[SceneViews]
) -> None:
    """Refuses evaluation targets that are training frames, and evaluation of places that are trained on.

    Scenes should differ altogether. Where one recording serves both ends, its targets must be frames held out of
    training, which is said in the log.

    Args:
        train: the training source.
        scenes: names of its scenes that are trained on.
        val: the evaluation source.
        evaluation: the evaluation samples.

    Raises:
        DataError: naming the first scene whose targets (whole scene, without targets) training would see, or whose
            place is shown by a training scene.
    """
    places = {train.place(scene): scene for scene in scenes}
    names = set(scenes)
    for views in evaluation:
        if views.scene in names:
            _refuse_seen_targets(train, views)
        elif (place := val.place(views.scene)) in places:
            raise DataError(
                f"evaluation scene {views.scene} and training scene {places[place]} show the same place ({place}): "
                "give disjoint scenes, such as the lists that `python -m vg2gt.data.splits` writes"
            )
    shared = {views.scene for views in evaluation} & names
    if shared:
        log.info("%d scenes serve training and evaluation; scored are frames held out of training", len(shared))


def _refuse_seen_targets(train: SceneSource, views: SceneViews) -> None:
    seen = set(training_frames(train, views.scene)) & set(views.target or views.context)
    if seen:
        raise DataError(
            f"scene {views.scene} is used for training and for evaluation: {len(seen)} of its evaluation frames are "
            "trained on; give disjoint scenes, such as the lists that `python -m vg2gt.data.splits` writes, or hold "
            "frames out of training (data.holdout)"
        )
