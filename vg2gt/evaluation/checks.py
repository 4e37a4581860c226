"""Checks before an evaluation: overlap with the training data, and missing depth or cameras."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path

from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig

from vg2gt.data.base import DataError, SceneSource
from vg2gt.data.datamodule import SceneDataModule
from vg2gt.data.overlap import refuse_overlap
from vg2gt.data.views import SceneSample
from vg2gt.model import Reconstructor
from vg2gt.runs.checkpoints import checkpoint_path, run_config_path
from vg2gt.runs.load import RESUMED_IN_PLACE, earlier_configs
from vg2gt.runs.untrusted import check_targets, read_run_config

log = logging.getLogger(__name__)

_UNCHECKED = "cannot check whether the evaluated scenes were used for training: %s"


def refuse_training_views(checkpoint: Path | None, source: SceneSource, views: Sequence[SceneSample]) -> None:
    """Refuses views that overlap with the training data of the checkpoint's run or of a run it was initialised from.

    All scenes of the training data count, including those left out as too short. If the training data or a run's
    configuration is missing, logs a warning that the overlap cannot be checked.

    Raises:
        DataError: if there is overlap, naming the first scene.
    """
    for path, run in _ancestry(checkpoint):
        try:
            if run.get("data") is None:
                raise ValueError(f"{path} names no data")
            check_targets(run.data, f"{path}: data")
            trained: SceneDataModule = instantiate(run.data)
            train = trained.train_source()
        except (OSError, ValueError, ImportError, InstantiationException) as error:
            log.warning(_UNCHECKED, error)
            continue
        refuse_overlap(train, list(train.scenes)[: trained.train_scenes], source, views)


def _ancestry(checkpoint: Path | None) -> Iterator[tuple[Path, DictConfig]]:
    """Yields the configurations of a checkpoint's run and of the runs that it was initialised from, newest first.

    A run that was resumed with other data has several.
    """
    seen: set[Path] = set()
    waiting = [checkpoint]
    while waiting:
        checkpoint = waiting.pop(0)
        if checkpoint is None or (path := run_config_path(checkpoint)) in seen:
            continue
        seen.add(path)
        for each in (path, *earlier_configs(path)):
            try:
                run = read_run_config(each)
            except (OSError, ValueError) as error:
                log.warning(_UNCHECKED, error)
                continue
            yield each, run
            for before in (run.get("init_from"), run.get("ckpt")):
                try:
                    waiting += [] if before in RESUMED_IN_PLACE else [checkpoint_path(str(before))]
                except FileNotFoundError:
                    log.warning(_UNCHECKED, f"{each}: the run started from {before}, which is not there")


def refuse_without_hints(model: Reconstructor, source: SceneSource) -> None:
    """Raises DataError if the data lacks cameras, or the depth that a backbone needs."""
    backend, sparse = model.backend, source.has_depth and not source.dense_depth
    lacking = ["depth"] if backend.needs_depth and (sparse or not source.has_depth) else []
    lacking += [] if source.has_cameras else ["cameras"]
    if lacking:
        raise DataError(
            f"backend {backend.name} needs the data's {' and '.join(lacking)}, and {type(source).__name__} has none"
            + (" (depth at sparse points is not enough)" if sparse else "")
            + ": choose another backend=, such as sweep, or other data"
        )
