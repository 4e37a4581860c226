"""Models of a scene from matched features: COLMAP's incremental and global mappers, and which models are sound."""

from __future__ import annotations

from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from pathlib import Path
from typing import TYPE_CHECKING

from vg2gt.reconstruction.monitor import Monitor
from vg2gt.reconstruction.sfm_pairs import ALL_PAIRS

if TYPE_CHECKING:
    from pycolmap import (  # pyright: ignore[reportMissingImports]
        GlobalPipelineOptions,
        IncrementalPipelineOptions,
        Reconstruction,
    )

FEWEST_POINTS = 20  # of a model that is one: a camera that only turned gives none
MOST_PLACED = 0.9  # share of the images with which the global mapper is believed at once


def map_cameras(work: Path, count: int, seed: int, monitor: Monitor) -> list[Reconstruction]:
    """Models of the scene, or of its parts: of many images by the global mapper, if that places nearly all.

    Args:
        work: folder with ``database.db``, in which features are matched, and ``images/``.
        count: how many images there are.
        seed: the same seed gives the same models.
        monitor: told of the stage.
    """
    import pycolmap  # pyright: ignore[reportMissingImports]

    database, images = work / "database.db", work / "images"
    pycolmap.set_random_seed(seed)
    for folder in ("at once", "one by one"):
        (work / folder).mkdir()
    expected = iter(range(count))
    with monitor.stage("place cameras", count) as advance:
        found = []
        if count > ALL_PAIRS:
            found = [*pycolmap.global_mapping(database, images, work / "at once", _global_options(seed)).values()]
            if any(len(placed_images(model)) >= MOST_PLACED * count for model in sound_models(found)):
                for _ in expected:
                    advance()
                return found
        found += pycolmap.incremental_mapping(
            database,
            images,
            work / "one by one",
            options=_incremental_options(seed),
            next_image_callback=lambda: advance() if next(expected, None) is not None else None,
        ).values()
    return found


def sound_models(models: Sequence[Reconstruction]) -> list[Reconstruction]:
    """Those with points, the one of most images first."""
    sound = [model for model in models if model.num_points3D() >= FEWEST_POINTS]
    return sorted(sound, key=lambda model: (model.num_reg_images(), model.num_points3D()), reverse=True)


def other_parts(models: Sequence[Reconstruction], taken: AbstractSet[str]) -> list[list[str]]:
    """Images of each model that are in none before it, nor among those taken."""
    parts, known = [], set(taken)
    for model in models:
        parts.append(sorted(placed_images(model) - known))
        known |= placed_images(model)
    return [part for part in parts if part]


def placed_images(model: Reconstruction) -> set[str]:
    """Names of the images that have a camera."""
    return {image.name for image in model.images.values() if image.has_pose}


def _global_options(seed: int) -> GlobalPipelineOptions:
    import pycolmap  # pyright: ignore[reportMissingImports]

    options = pycolmap.GlobalPipelineOptions()
    mapper = options.mapper
    options.num_threads = mapper.num_threads = 1
    options.random_seed = mapper.random_seed = mapper.rotation_averaging.random_seed = seed
    mapper.global_positioning.random_seed = mapper.retriangulation.random_seed = seed
    mapper.global_positioning.use_gpu = mapper.bundle_adjustment.ceres.use_gpu = False
    return options


def _incremental_options(seed: int) -> IncrementalPipelineOptions:
    import pycolmap  # pyright: ignore[reportMissingImports]

    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1  # sums in a fixed order: the same images, the same cameras
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    return options
