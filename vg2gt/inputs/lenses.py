"""Lenses in structure from motion: those found, and whether images that share one need their own (zoom, crops)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from vg2gt.data.sources.undistortion import lens_text
from vg2gt.inputs.pictures import Picture

if TYPE_CHECKING:
    from pycolmap import Reconstruction  # pyright: ignore[reportMissingImports]

# Ratio of a focal length to the median one: 1.08 at most in photographs of one lens, 1.2 and more if zoomed by 1.5.
_DIFFERS = 1.15
_FEWEST, _POINTS = 30, 4000  # points that an image sees, so that they tell its focal length, and points that are used
_ITERATIONS = 50

Lenses = dict[tuple[int, int, float], list[str]]
"""Names of images by height, width and focal length in pixels (0: unknown)."""


def lens_texts(model: Reconstruction, pictures: Mapping[str, Picture]) -> dict[str, str]:
    """Returns the lenses of the photographs as taken, by their names."""
    placed = (image for image in model.images.values() if image.has_pose)
    return {pictures[each.name].name: lens_text(each.camera, pictures[each.name].size) for each in placed}


def own_lenses(model: Reconstruction, lenses: Lenses) -> Lenses:
    """Returns a lens for each image, with its focal length, if these differ more than those of ``lenses``; else empty.

    A model of images of several focal lengths that share one has small errors: it places cameras nearer instead. With
    a lens of its own for each, a bundle adjustment of its points moves the focal lengths apart.
    """
    focals = _own_focals(model)
    shared = {each.name: float(each.camera.params[0]) for each in model.images.values()}
    ratios = np.log([focal / shared[name] for name, focal in focals.items()])
    if not len(ratios) or np.abs(ratios - np.median(ratios)).max() <= np.log(_DIFFERS):
        return {}
    found: Lenses = {}
    for (height, width, _), names in lenses.items():
        for name in names:
            found.setdefault((height, width, round(focals.get(name, 0.0), 1)), []).append(name)
    return found


def _own_focals(model: Reconstruction) -> dict[str, float]:
    """Returns the focal lengths, in pixels, of images with a lens of their own, by name."""
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
    points = sorted(model.points3D.values(), key=lambda point: -point.track.length())[:_POINTS]
    for point in points:
        single.add_point3D(point.xyz, point.track, point.color)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = options.refine_extra_params = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.max_num_iterations = _ITERATIONS
    options.ceres.solver_options.num_threads = 1  # fixed order of sums
    pycolmap.bundle_adjustment(single, options)
    seen = [image for image in single.images.values() if image.num_points3D >= _FEWEST]
    return {image.name: float(image.camera.params[0]) for image in seen}
