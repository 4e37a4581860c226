"""Photographs of another shape than the others are padded instead of cropped; masks say where nothing was seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch.nn import functional as F

from vg2gt.data.base import Frames
from vg2gt.geometry.cameras import crop_intrinsics
from vg2gt.inputs.inputs import PADDED, working_size
from vg2gt.inputs.pictures import Picture

_LEAST_KEPT = 0.8  # share of a picture's area; one that would lose more to cropping is padded


def of_one_shape(
    pictures: Sequence[Picture], patch: int, device: str, size: int | tuple[int, int] | None = None
) -> tuple[list[Picture], tuple[int, int]]:
    """Returns the pictures, padded where needed, and their working size (:func:`vg2gt.inputs.inputs.working_size`)."""
    target = working_size([picture.size for picture in pictures], patch, device, size)
    return [padded(picture, target) for picture in pictures], target


def padded(picture: Picture, shape: tuple[int, int]) -> Picture:
    """Returns a picture with the aspect ratio of ``shape`` (height, width), padded if cropping would cost a lot of it.

    Its ``whole`` is then the picture without padding.
    """
    ratio = picture.size[0] * shape[1] / (picture.size[1] * shape[0])
    if min(ratio, 1 / ratio) >= _LEAST_KEPT:
        return picture

    def read(wanted: tuple[int, int]) -> Frames:
        inner = (round(wanted[0] * picture.size[0] / size[0]), round(wanted[1] * picture.size[1] / size[1]))
        return _padded_frames(picture.read((max(inner[0], 1), max(inner[1], 1))), picture.size, size)

    size, matrix, points = _canvas(picture.size, shape), picture.intrinsics, picture.points
    corner = np.array([(size[1] - picture.size[1]) // 2, (size[0] - picture.size[0]) // 2])
    if matrix is not None:
        matrix = matrix.copy()
        matrix[:2, 2] += corner
    if points is not None:
        places = (points.places * picture.size[::-1] + corner) / size[::-1]
        points = replace(points, places=places)
    return replace(picture, size=size, read=read, intrinsics=matrix, points=points, whole=picture)


def _canvas(size: tuple[int, int], shape: tuple[int, int]) -> tuple[int, int]:
    height, width = size
    return max(height, round(width * shape[0] / shape[1])), max(width, round(height * shape[1] / shape[0]))


def _padded_frames(frames: Frames, before: tuple[int, int], after: tuple[int, int]) -> Frames:
    """Pads frames of a picture, which may be reduced, as its size ``before`` is padded to ``after``."""
    height, width = frames.images.shape[-2:]
    rows, columns = (round(new * own / old) for new, old, own in zip(after, before, (height, width), strict=True))
    top, left = (
        round((new - old) // 2 * own / old) for new, old, own in zip(after, before, (height, width), strict=True)
    )
    sides = (left, columns - width - left, top, rows - height - top)
    mask = torch.ones_like(frames.images[:, 0]) if frames.mask is None else frames.mask
    return replace(
        frames,
        images=F.pad(frames.images, sides),
        depth=F.pad(frames.depth, sides),
        intrinsics=crop_intrinsics(frames.intrinsics, -left, -top),
        mask=F.pad(mask, sides, value=PADDED),
    )
