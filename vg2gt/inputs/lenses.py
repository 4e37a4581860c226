"""Lenses in structure from motion: those found, and whether the images need others than those they were given."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from vg2gt.data.sources.undistortion import lens_text
from vg2gt.inputs.pair_evidence import Matches
from vg2gt.inputs.pictures import Picture

if TYPE_CHECKING:
    from pycolmap import Reconstruction  # pyright: ignore[reportMissingImports]

log = logging.getLogger(__name__)

Lenses = dict[tuple[int, int, float], list[str]]
"""Names of images by height, width and focal length in pixels (0 or less: unknown)."""
Found: TypeAlias = "tuple[Matches, list[Reconstruction]]"
"""Matches of images and their models, the largest one first."""
Mapped: TypeAlias = Callable[[Lenses, bool], Found]
"""Maps images with lenses, whose centres are in the middle of the images or, if asked, found as well."""

# Crops that keep the focal length of the whole photograph: it changes by 1.05 to 1.7, or 9 to 13 % of the matches fit
# no camera with it. Right ones change by up to 1.04, and nearly all matches fit.
_DRIFT, _UNFIT = 1.08, 0.05
# Focal lengths that differ from the median one by this factor come of a zoom if the median errors of these images fall
# to this share: 0.26 to 0.65 with zooms of 1.2 to 2. Photographs of a single lens have 0.89 and more, though their
# focal lengths may differ by 1.15 as well.
_DIFFERS, _EXPLAINED = 1.07, 0.75
_FEWEST, _POINTS = 30, 4000  # points that an image sees, so that they tell its focal length, and points that are used
# Crops away from the middle: with free centres, the errors fall to 0.55 and the centres move by 0.13 of the longer
# side or more. Whole photographs have 0.87 and more, and up to 0.04; zooms as little shift.
_CENTRED, _SHIFT = 0.7, 0.07
_FARTHEST = 0.35  # of the longer side: centres of likely crops. An orbit alone does not tell the centre of each image
_ITERATIONS = 50


def lens_texts(model: Reconstruction, pictures: Mapping[str, Picture]) -> dict[str, str]:
    """Returns the lenses of the photographs as taken, by their names."""
    placed = (image for image in model.images.values() if image.has_pose)
    return {pictures[each.name].name: lens_text(each.camera, pictures[each.name].size) for each in placed}


def is_centre_found(model: Reconstruction) -> bool:
    """Returns whether the centres of a model's lenses are not in the middle of the images."""
    return max(_shifts(model).values(), default=0.0) > 1e-6


def with_right_lenses(database: Path, lenses: Lenses, mapped: Mapped) -> Found:
    """Returns the matches and the models of images, with other lenses if the given ones do not explain the images.

    Args:
        database: COLMAP's database of the images mapped last.
        lenses: lenses of the images by their EXIF data.
        mapped: maps the images with other lenses.
    """
    found = mapped(lenses, False)
    if _doubts_focal(database, found[1]) and (
        other := _tried(
            database, partial(mapped, _free(lenses), False), lambda models: _extent(models) >= _extent(found[1])
        )
    ):
        log.warning("the focal lengths of the EXIF data do not fit the images (are they cropped?) and are not used")
        lenses, found = _free(lenses), other
    if not found[1]:
        return found
    first = found[1][0]
    ratios, moved = _with_free_lenses(first)
    if min(ratios, default=1.0) > _EXPLAINED:  # no lenses explain any image much better
        return found
    if _is_off_centre(ratios, moved):  # before zooms, whose centres move little
        for others in (_free(lenses), _free(lenses, each=True)):
            if other := _tried(database, partial(mapped, others, True), lambda models: _is_centred(models, first)):
                log.warning(
                    "the images are crops away from the middle of their photographs: the centres of their lenses are "
                    "found with the cameras, which is less sure; give the whole photographs if you have them"
                )
                return other
        log.warning(
            "the images do not fit a lens with its centre in their middle, so the cameras may be wrong: are they "
            "crops? Give the whole photographs"
        )
    if own := own_lenses(first, lenses):
        log.warning("the focal length changes from image to image (zoom, or crops): each gets a lens of its own")
        return mapped(own, False)
    return found


def _tried(
    database: Path, mapped: Callable[[], Found], accepts: Callable[[list[Reconstruction]], bool]
) -> Found | None:
    """Returns the matches and models of other lenses if they are accepted; else None, with the database as before."""
    kept = database.rename(database.with_suffix(".kept"))
    try:
        found = mapped()
        if accepts(found[1]):
            return found
    except ValueError:  # what the images cannot be mapped with is no better
        log.debug("other lenses failed", exc_info=True)
    kept.replace(database)
    return None


def _free(lenses: Lenses, each: bool = False) -> Lenses:
    """Returns lenses of unknown focal length, one for the images of a size or, if asked, for each image."""
    free: Lenses = {}
    for (height, width, _), names in lenses.items():
        for name in names:
            free.setdefault((height, width, -float(each and len(free))), []).append(name)
    return free


def _extent(models: Sequence[Reconstruction]) -> tuple[int, int]:
    """Returns the numbers of images and points of the largest model."""
    return (models[0].num_reg_images(), models[0].num_points3D()) if models else (0, 0)


def _is_centred(models: Sequence[Reconstruction], first: Reconstruction) -> bool:
    """Returns whether the largest model has as many images as the first one, and likely lenses of right centres."""
    if _extent(models)[0] < first.num_reg_images() or _is_off_centre(*_with_free_lenses(models[0])):
        return False
    return max(_shifts(models[0]).values()) < _FARTHEST


def _shifts(model: Reconstruction) -> dict[str, float]:
    """Returns how far the centres of the lenses are from the middle of images, relative to the longer side, by name."""
    cameras = {image.name: image.camera for image in model.images.values() if image.has_pose}
    return {
        name: max(abs(camera.params[1] - camera.width / 2), abs(camera.params[2] - camera.height / 2))
        / max(camera.width, camera.height)
        for name, camera in cameras.items()
    }


def _with_free_lenses(model: Reconstruction) -> tuple[list[float], list[float]]:
    """Frees the focal length and the centre of each image: how its error changes, and how far its centre moves."""
    single = _with_own_lenses(model)
    before, middle = _errors(single), _shifts(single)
    _adjust(single, centre=True)
    seen, after, shifts = _focals(single), _errors(single), _shifts(single)
    return (
        [after[name] / max(before[name], 1e-9) for name in seen],
        [abs(shifts[name] - middle[name]) for name in seen],
    )


def _is_off_centre(ratios: Sequence[float], moved: Sequence[float]) -> bool:
    """Returns whether other centres of its lenses explain the images of a model much better."""
    return bool(ratios) and bool(np.median(ratios) < _CENTRED and np.median(moved) > _SHIFT)


def _doubts_focal(database: Path, models: Sequence[Reconstruction]) -> bool:
    """Returns whether the images contradict focal lengths that they were given."""
    import pycolmap  # pyright: ignore[reportMissingImports]

    with closing(pycolmap.Database.open(database)) as opened:
        cameras = {each.camera_id: each for each in opened.read_all_cameras() if each.has_prior_focal_length}
        pairs = opened.read_two_view_geometries()[1] if cameras else []
    counts = {True: 0, False: 0}
    for pair in pairs:
        counts[pair.config == pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED] += len(pair.inlier_matches)
    found = [each for each in models[0].cameras.values() if each.camera_id in cameras] if models else []
    drifts = [abs(np.log(each.params[0] / cameras[each.camera_id].params[0])) for each in found]
    unfit = counts[True] > _UNFIT * sum(counts.values())
    return bool(cameras) and (not models or unfit or max(drifts, default=0.0) > np.log(_DRIFT))


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


def _adjust(model: Reconstruction, centre: bool = False) -> None:
    """Adjusts poses, points, focal lengths and, if asked, centres; unlike ``pycolmap``'s own, without its log."""
    import pycolmap  # pyright: ignore[reportMissingImports]

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = options.refine_extra_params = False
    options.refine_principal_point = centre
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
