"""Models of a scene from matched features: COLMAP's incremental mapper, and selection of sound models."""

from __future__ import annotations

from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from pathlib import Path
from typing import TYPE_CHECKING

from vg2gt.reconstruction.monitor import Monitor

if TYPE_CHECKING:
    from pycolmap import (  # pyright: ignore[reportMissingImports]
        IncrementalPipelineOptions,
        Reconstruction,
    )

FEWEST_POINTS = 20  # minimum number of points of a sound model: a camera that only rotates yields none


def map_cameras(work: Path, count: int, seed: int, monitor: Monitor) -> list[Reconstruction]:
    """Returns models of the scene, or of its parts, from the incremental mapper.

    The global mapper (``pycolmap.global_mapping``) is not used: on the fox scene it places all 24 photographs with a
    small reprojection error, but a quarter of the path away from their positions, even with calibrated focal lengths.

    Args:
        work: folder with ``images/`` and ``database.db``, which holds the matched features.
        count: number of images.
        seed: random seed; the same seed gives the same models.
        monitor: shows and times the stage.
    """
    import pycolmap  # pyright: ignore[reportMissingImports]

    pycolmap.set_random_seed(seed)
    (work / "models").mkdir()
    expected = iter(range(count))
    with monitor.stage("place cameras", count) as advance:
        models = pycolmap.incremental_mapping(
            work / "database.db",
            work / "images",
            work / "models",
            options=_options(seed),
            next_image_callback=lambda: advance() if next(expected, None) is not None else None,
        )
    return list(models.values())


def sound_models(models: Sequence[Reconstruction]) -> list[Reconstruction]:
    """Returns the models with enough points, the one with most images first."""
    sound = [model for model in models if model.num_points3D() >= FEWEST_POINTS]
    return sorted(sound, key=lambda model: (model.num_reg_images(), model.num_points3D()), reverse=True)


def other_parts(models: Sequence[Reconstruction], taken: AbstractSet[str]) -> list[list[str]]:
    """Returns the images of each model that are in no earlier model and not in ``taken``, without empty lists."""
    parts, known = [], set(taken)
    for model in models:
        parts.append(sorted(placed_images(model) - known))
        known |= placed_images(model)
    return [part for part in parts if part]


def placed_images(model: Reconstruction) -> set[str]:
    """Returns the names of the images that have a camera."""
    return {image.name for image in model.images.values() if image.has_pose}


def _options(seed: int) -> IncrementalPipelineOptions:
    import pycolmap  # pyright: ignore[reportMissingImports]

    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1  # fixed order of sums: reproducible cameras
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    return options
