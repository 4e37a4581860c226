"""Sources of a reconstruction's cameras: files next to the images, structure from motion, or the backbone."""

from __future__ import annotations

import importlib.util
import logging
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import numpy as np

from vg2gt.data.base import DataError
from vg2gt.data.sources.masks import AmbiguousMaskError
from vg2gt.inputs.camera_check import check_cameras
from vg2gt.inputs.foreign import unread_camera_files
from vg2gt.inputs.given_cameras import LAYOUTS, describe, given_pictures
from vg2gt.inputs.pictures import ImagesLike, Picture, as_items, check_pictures, find_pictures
from vg2gt.inputs.sfm import OTHERWISE, PURPOSE, find_cameras
from vg2gt.inputs.usable import usable_pictures
from vg2gt.io.colmap import require_pycolmap
from vg2gt.io.errors import FormatError, some
from vg2gt.io.files import by_number
from vg2gt.model import Reconstructor
from vg2gt.monitor import Monitor
from vg2gt.types import check_choice

log = logging.getLogger(__name__)

_SAME_PLACE = 1e-9  # distance of cameras at one place, relative to that from the origin

Poses = Literal["auto", "given", "sfm"]


@contextmanager
def pictures_for(
    model: Reconstructor,
    images: ImagesLike,
    poses: Poses = "auto",
    *,
    max_images: int | None = None,
    sfm_folder: str | Path | None = None,
    monitor: Monitor | None = None,
) -> Iterator[list[Picture]]:
    """Yields the pictures to reconstruct, with cameras if the backbone takes any; they can be read inside the block.

    Args:
        model: model that will reconstruct them.
        images: see :func:`vg2gt.inputs.pictures.find_pictures`.
        poses: ``auto``: a backbone that needs cameras gets those next to the images
            (:func:`~vg2gt.inputs.given_cameras.given_pictures`), else those of structure from motion
            (:func:`~vg2gt.inputs.sfm.find_cameras`); other backbones predict their own. ``given`` and ``sfm``
            allow only that source.
        max_images: maximum number of pictures, evenly spread.
        sfm_folder: folder for the result of structure from motion; None: a temporary one.
        monitor: shows and times the stages.

    Yields:
        The pictures that are of use (:func:`~vg2gt.inputs.usable.usable_pictures`).

    Raises:
        FileNotFoundError: if a path does not exist.
        ImportError: if structure from motion needs pycolmap and it is not installed.
        ValueError: if there are no pictures, the requested cameras are not available or contradict the images, or the
            backbone takes none.
    """
    backend = model.backend
    check_choice("poses", poses, Poses)
    if poses != "auto" and not backend.needs_hints:
        raise ValueError(
            f"backend {backend.name} predicts its own cameras and accepts none: omit --poses, or use a backend that "
            "accepts them, such as backend=da3_small backend.given_poses=true"
        )
    if poses == "sfm" and backend.needs_depth:
        raise ValueError(f"backend {backend.name} works from the depth and poses of a recording; leave --poses out")
    monitor = monitor or Monitor()
    if not backend.needs_hints:
        yield usable_pictures(find_pictures(images, max_images), monitor)
        return
    given = None
    if poses != "sfm":
        given = _given_pictures(images, max_images, backend.needs_depth, poses)
    if given is not None:
        usable = usable_pictures(given, monitor)
        if not backend.needs_depth:
            _check_places(usable)
            check_cameras(usable, monitor, insisted=poses == "given")
        yield usable
        return
    if backend.needs_depth:
        raise ValueError(_no_depth(backend.name, images))
    if poses == "given":
        raise ValueError(
            f"no cameras next to {describe(images)}: expected {LAYOUTS}; --poses sfm finds them from the images"
        )
    if poses == "auto":
        _name_unread(images)
    with tempfile.TemporaryDirectory(prefix="vg2gt-sfm-") as temporary:
        pictures = usable_pictures(find_pictures(images, max_images), monitor)
        place = {picture.name: number for number, picture in enumerate(pictures)}
        if all(picture.path is not None for picture in pictures):  # so that the order of the files does not matter
            pictures = sorted(pictures, key=lambda picture: by_number(str(picture.path)))
        found = find_cameras(pictures, Path(sfm_folder or f"{temporary}/sfm"), monitor)
        yield sorted(found, key=lambda picture: place[picture.name])


def check_inputs(backend: type, images: Sequence[str], poses: Poses) -> None:
    """Checks the images, before anything is built: that they can be read, and have or can get what a backend needs.

    Args:
        backend: class of the backend.
        images: files and folders.
        poses: see :func:`pictures_for`.

    Raises:
        FileNotFoundError: if a path does not exist.
        ImportError: if a package is not installed; the message says what needs it and how to install it.
        ValueError: if there are no pictures, or they lack depth.
    """
    if getattr(backend, "needs_depth", False) and given_pictures(images, depth=True) is None:
        raise ValueError(_no_depth(backend.__name__, images))
    check_pictures(images)
    needed = poses == "sfm" or getattr(backend, "needs_cameras", False)
    if needed and importlib.util.find_spec("pycolmap") is None and (poses == "sfm" or given_pictures(images) is None):
        require_pycolmap(PURPOSE, OTHERWISE)


def _given_pictures(images: ImagesLike, max_images: int | None, depth: bool, poses: Poses) -> list[Picture] | None:
    """Returns :func:`given_pictures`; its errors name ``--poses sfm`` where structure from motion is a way out."""
    try:
        return given_pictures(images, max_images, depth=depth)
    except (DataError, FormatError) as error:
        if poses == "given" or depth or isinstance(error, AmbiguousMaskError):
            raise
        raise DataError(
            f"cannot use the camera files of {describe(images)}: {error}; --poses sfm ignores them and finds the "
            "cameras from the images"
        ) from error


def _check_places(pictures: Sequence[Picture]) -> None:
    """Checks that given cameras are at different places.

    Raises:
        DataError: if all are at one, from which depth cannot be seen.
    """
    poses = [picture.pose for picture in pictures if picture.pose is not None]
    if len(poses) < 2 or len(poses) < len(pictures):
        return
    centers = np.stack([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])
    if np.ptp(centers, axis=0).max() <= _SAME_PLACE * max(float(np.abs(centers).max()), 1e-3):
        raise DataError(
            f"all {len(poses)} cameras of {pictures[0].source} are at one place, from which depth cannot be seen: "
            "correct their positions, or leave them out with --poses sfm"
        )


def _name_unread(images: ImagesLike) -> None:
    """Warns about files next to the images that may have cameras but are not read."""
    paths = [Path(item).expanduser() for item in as_items(images) if isinstance(item, (str, Path))]
    folders = dict.fromkeys(path if path.is_dir() else path.parent for path in paths)
    if files := [str(file) for folder in folders for file in unread_camera_files(folder)]:
        log.warning("the cameras are found from the images; not read as cameras: %s (%s are)", some(files), LAYOUTS)


def _no_depth(backend: str, images: ImagesLike) -> str:
    return (
        f"backend {backend} needs measured depth, but {describe(images)} has none: it reconstructs RGB-D recordings "
        "only (depth/ next to images/, with poses.txt and K.txt). For photographs, omit backend= and --ckpt (uses the "
        "built-in plane sweep), or use backend=da3_small; a checkpoint only works with the backend it was trained on"
    )
