"""Lenses in structure from motion: those found, and whether images that share one need their own (zoom, crops)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from vg2gt.data.sources.undistortion import lens_text
from vg2gt.inputs.pictures import Picture

if TYPE_CHECKING:
    from pycolmap import Reconstruction  # pyright: ignore[reportMissingImports]

# Focal lengths that differ from the median one by this factor come of a zoom if the median errors of these images fall
# to this share: 0.26 to 0.65 with zooms of 1.2 to 2. Photographs of a single lens have 0.89 and more, though their
# focal lengths may differ by 1.15 as well.
_DIFFERS, _EXPLAINED = 1.07, 0.75
_FEWEST, _POINTS = 30, 4000  # points that an image sees, so that they tell its focal length, and points that are used
_ITERATIONS = 50

Lenses = dict[tuple[int, int, float], list[str]]
"""Names of images by height, width and focal length in pixels (0: unknown)."""


def lens_texts(model: Reconstruction, pictures: Mapping[str, Picture]) -> dict[str, str]:
    """Returns the lenses of the photographs as taken, by their names."""
    placed = (image for image in model.images.values() if image.has_pose)
    return {pictures[each.name].name: lens_text(each.camera, pictures[each.name].size) for each in placed}


def own_lenses(model: Reconstruction, lenses: Lenses) -> Lenses:
    """Returns a lens for each image, with its focal length, if this explains the images much better; else empty.

    A model of images of several focal lengths that share one has small errors: it places cameras nearer instead. With
    a lens of its own for each, a bundle adjustment of its points moves the focal lengths apart and the errors fall.
    """
    single = _with_own_lenses(model)
    shared, before = _focals(single), _errors(single)
    _adjust(single)
    focals, after = _focals(single), _errors(single)
    ratios = {name: np.log(focal / shared[name]) for name, focal in focals.items()}
    middle = np.median(list(ratios.values())) if ratios else 0.0
    others = [name for name, ratio in ratios.items() if abs(ratio - middle) > np.log(_DIFFERS)]
    if not others or np.median([after[name] / max(before[name], 1e-9) for name in others]) > _EXPLAINED:
        return {}
    found: Lenses = {}
    for (height, width, _), names in lenses.items():
        for name in names:
            found.setdefault((height, width, round(focals.get(name, 0.0), 1)), []).append(name)
    return found


def _with_own_lenses(model: Reconstruction) -> Reconstruction:
    """Returns a model of the points that most images see, with a camera for each image."""
    import pycolmap  # pyright: ignore[reportMissingImports]

    single = pycolmap.Reconstruction()
    for number, image in sorted(model.images.items()):
        if image.has_pose:
            camera = pycolmap.Camera(model.cameras[image.camera_id].todict())
            camera.camera_id = number
            single.add_camera_with_trivial_rig(camera)
            pixels = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
            single.add_image_with_trivial_frame(
                pycolmap.Image(image.name, pixels, number, number), image.cam_from_world()
            )
    for point in sorted(model.points3D.values(), key=lambda point: -point.track.length())[:_POINTS]:
        single.add_point3D(point.xyz, point.track, point.color)
    return single


def _adjust(model: Reconstruction) -> None:
    """Adjusts poses, points and focal lengths; unlike ``pycolmap.bundle_adjustment``, without switching on the log."""
    import pycolmap  # pyright: ignore[reportMissingImports]

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = options.refine_extra_params = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.max_num_iterations = _ITERATIONS
    options.ceres.solver_options.num_threads = 1  # fixed order of sums
    config = pycolmap.BundleAdjustmentConfig()
    for number in model.images:
        config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def _focals(model: Reconstruction) -> dict[str, float]:
    """Returns the focal lengths, in pixels, of images with enough points to tell them, by name."""
    seen = (image for image in model.images.values() if image.num_points3D >= _FEWEST)
    return {image.name: float(image.camera.params[0]) for image in seen}


def _errors(model: Reconstruction) -> dict[str, float]:
    """Returns the median distances of points from where images see them, in pixels, by name."""
    found = {}
    for image in model.images.values():
        seen = [point for point in image.points2D if point.has_point3D()]
        pixels = (image.project_point(model.points3D[point.point3D_id].xyz) for point in seen)
        off = [np.linalg.norm(at - point.xy) for at, point in zip(pixels, seen, strict=True) if at is not None]
        found[image.name] = float(np.median(off)) if off else 0.0
    return found
