"""One image with a given camera: which way up its file is, its size on disk, and how it becomes a pinhole's image.

A file or camera that does not fit is a ``DataError``.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from vg2gt.data.base import DataError
from vg2gt.data.sources.index import PosedImage
from vg2gt.data.sources.undistortion import is_pinhole, lens_text, undistortion_of
from vg2gt.geometry.cameras import resize_intrinsics
from vg2gt.io.colmap import Camera, colmap_intrinsics
from vg2gt.io.image_files import Size, image_size, orientation


def size_on_disk(
    path: Path, scene: str, expected: Size, where: str, is_stored: Callable[[], bool] | None = None
) -> tuple[Size, bool]:
    """An image's ``(height, width)`` on disk, and whether it is turned upright as its EXIF data says.

    Cameras may have been made for the image as stored or for the upright one: the shape tells, and where both fit the
    upright one is taken.

    Args:
        path: the image.
        scene: its scene, for messages.
        expected: ``(height, width)`` of its camera; the image may be a reduced one.
        where: what the camera is from, for the message.
        is_stored: called where both shapes fit; True if the camera belongs to the image as stored.
    """
    turned = orientation(path, scene)
    stored = image_size(path, scene)
    upright = image_size(path, scene, upright=True)
    if turned != 1 and _has_shape(upright, expected):
        as_stored = _has_shape(stored, expected) and is_stored is not None and is_stored()
        return (stored, False) if as_stored else (upright, True)
    if _has_shape(stored, expected):
        return stored, False
    exif = f" (EXIF orientation {turned}, upright {upright[1]}x{upright[0]})" if turned != 1 else ""
    raise DataError(
        f"{path} is {stored[1]}x{stored[0]} pixels{exif}, but its camera in {where} {expected[1]}x{expected[0]}: it is "
        "not the image the camera was made for, nor a reduced one"
    )


def posed_image(
    camera: Camera | NDArray[np.float64], camera_size: Size, size: Size, upright: bool, mask: Path | None, where: str
) -> PosedImage:
    """What an index keeps of an image with a camera.

    Args:
        camera: a COLMAP camera, or the intrinsics ``[3, 3]`` of a pinhole (integer pixel centres).
        camera_size: ``(height, width)`` that the camera is of.
        size: of the image on disk.
        upright: see :func:`size_on_disk`.
        mask: its mask file.
        where: what the camera is from, for the message.
    """
    kept = "" if mask is None else str(mask.resolve())
    try:
        if isinstance(camera, np.ndarray) or is_pinhole(camera):
            matrix = camera if isinstance(camera, np.ndarray) else colmap_intrinsics(camera)
            scale = (size[1] / camera_size[1], size[0] / camera_size[0])
            matrix = resize_intrinsics(torch.from_numpy(np.asarray(matrix, np.float64)), *scale).numpy()
            return PosedImage(size, matrix, "", upright, kept)
        lens = lens_text(camera, size)
        undistortion = undistortion_of(lens)
    except ValueError as error:
        raise DataError(f"{where}: {error}") from error
    return PosedImage(undistortion.size, undistortion.intrinsics, lens, upright, kept)


def _has_shape(size: Size, camera: Size) -> bool:
    # Sizes are whole pixels, so that both directions of a reduced image may be off by one.
    return abs(size[0] * camera[1] / (size[1] * camera[0]) - 1) <= 2 / min(size)
