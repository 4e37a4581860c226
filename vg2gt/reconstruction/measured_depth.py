"""What is wrong with depth that an RGB-D device measured: another unit, another image, not aligned to the colours."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from vg2gt.geometry.cameras import strided_intrinsics
from vg2gt.inputs.pictures import Picture
from vg2gt.types import Cameras, Geometry
from vg2gt.visibility import Status, pixel_evidence

# Share of pixels, in the median view, in which measured depth is wrong; 0.02 at most in three recordings, 0.08 with 2 %
# of noise on top, 0.29 and more with another unit, inverse depth or distances along rays.
_MEASURED = 0.15
# Fewest and most images, and their longer side in pixels, whose depth is tried at the image before and after; share of
# the pixels that contradict others, above which a neighbour with half of it is the right image.
_FEWEST, _COMPARED, _SMALL, _SHIFTED = 4, 24, 160, 0.02
# Steps of depth and edges of images lie on each other in right recordings: up to 1 pixel of 320 apart in three of them.
_SIDE, _REACH = 320, 20  # longer side of the copies, and greatest offset, in pixels
_FEWEST_ALIGNED, _LOOKED_AT = 12, 32  # fewest and most images
_STEP, _AROUND, _NOISE = 1.08, 31, 2.0  # ratio of depths at a step; pixels and values over which edges are normalised
_FEWEST_STEPS = 150  # pixels at steps of each half of the images
_APART, _ALIKE = 3, 2  # least offset that is said, in pixels, and greatest difference of what two halves show
_STRONG, _CLEARER = 0.15, 1.25  # edges there above those elsewhere, and how much more that is than without an offset


def doubt_of_depth(pictures: Sequence[Picture], support: Tensor) -> str:
    """Returns what is wrong with measured depth that contradicts other views; empty if nothing is, or none is measured.

    Args:
        pictures: the views.
        support: ``[V, H, W]`` :class:`vg2gt.visibility.Status` of each pixel.
    """
    if not all(picture.has_depth for picture in pictures):
        return ""
    if by := _shift_of_depth(pictures):
        whose = "before" if by > 0 else "after"
        return f"the measured depth of images is that of the image {whose} them, which it fits better: pair them again"
    if offset := offset_of_depth(pictures):
        return (
            f"the measured depth does not lie on the images: its steps fit their edges about {math.hypot(*offset):.0f} "
            "pixels away. Use depth that is aligned to the colour camera (registered)"
        )
    against = torch.stack([(view == Status.CONTRADICTED).float().mean() for view in support]).median().item()
    if against <= _MEASURED:
        return ""
    return (
        f"the measured depth of most images contradicts that of others, in {100 * against:.0f} % of their pixels: "
        "check that it is in the unit of the poses (integers: 1,000 a metre), along the camera's axis rather than the "
        "ray, not inverse, and of these images and poses"
    )


def _shift_of_depth(pictures: Sequence[Picture]) -> int:
    """Returns 1 if the depth of images fits the image before each, -1 the one after, 0 if it fits the image itself.

    Small copies of a row of images are compared. Of right recordings, .02 of the pixels contradict others at most, also
    with 2 % of noise, and six times as many or more if shifted by an image.
    """
    if len(pictures) < _FEWEST or len({picture.size for picture in pictures}) > 1:
        return 0
    middle = max(len(pictures) - _COMPARED, 0) // 2
    step = math.ceil(max(pictures[0].size) / _SMALL)
    looked = []
    for picture in pictures[middle : middle + _COMPARED]:
        seen = picture.read(picture.size)
        reduced = seen.depth[0, step // 2 :: step, step // 2 :: step].clone()  # frees the full size
        looked.append((reduced, seen.world_to_camera[0], seen.intrinsics[0]))
    depth, poses, intrinsics = (torch.stack(values) for values in zip(*looked, strict=True))
    inner, small = torch.arange(1, len(depth) - 1), (depth.shape[1], depth.shape[2])
    cameras = Cameras(poses[None, inner], strided_intrinsics(intrinsics, step, step)[None, inner], small)
    against = {}
    for by in (0, 1, -1):
        moved = depth[None, inner + by]
        geometry = Geometry(moved, torch.ones_like(moved), cameras, torch.ones(1))
        against[by] = float((pixel_evidence(geometry)[1] == Status.CONTRADICTED).float().mean())
    best = min(against, key=lambda by: against[by])
    return best if against[0] > _SHIFTED and against[best] < against[0] / 2 else 0


def offset_of_depth(pictures: Sequence[Picture]) -> tuple[int, int] | None:
    """Finds where the steps of measured depth lie relative to the edges of the images.

    Args:
        pictures: pictures with depth.

    Returns:
        How many pixels to the right and down depth lies from where the images show it, if that is about 1 % of the
        longer side or more and clear; else None.
    """
    cell = max(1, round(max(pictures[0].size) / _SIDE))
    if (
        len(pictures) < _FEWEST_ALIGNED
        or min(pictures[0].size) < 6 * _REACH * cell
        or len({each.size for each in pictures}) > 1
    ):
        return None
    looked_at = pictures[:: math.ceil(len(pictures) / _LOOKED_AT)]
    halves = [_strength(part, cell) for part in (looked_at[: len(looked_at) // 2], looked_at[len(looked_at) // 2 :])]
    if min(count for _, count in halves) < _FEWEST_STEPS:
        return None
    strength = halves[0][0] + halves[1][0]
    excess = strength / np.median(strength) - 1
    down, right = _peak(strength)
    clear = excess.max() > max(_STRONG, _CLEARER * excess[_REACH, _REACH])
    if not clear or not _APART <= max(abs(down), abs(right)) < _REACH:
        return None
    # a pattern on a floor may fit elsewhere in some images, but not in others
    alike = all(max(abs(y - down), abs(x - right)) <= _ALIKE for y, x in (_peak(own) for own, _ in halves))
    return (-right * cell, -down * cell) if alike else None


def _strength(pictures: Sequence[Picture], cell: int) -> tuple[NDArray[np.float64], float]:
    """Returns the edges of images, summed over the steps of their depth, at each offset, and the number of steps."""
    reach, strength, count = range(-_REACH, _REACH + 1), np.zeros((2 * _REACH + 1, 2 * _REACH + 1)), 0.0
    for picture in pictures:
        image, steps = _edges(picture, cell)
        product = np.fft.irfft2(np.fft.rfft2(image) * np.fft.rfft2(steps).conj(), image.shape)  # cross-correlation
        strength += product[np.ix_(reach, reach)]
        count += float(steps.sum())
    return strength, count


def _peak(strength: NDArray[np.float64]) -> tuple[int, int]:
    down, right = (int(index) - _REACH for index in np.unravel_index(strength.argmax(), strength.shape))
    return down, right


def _edges(picture: Picture, cell: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Returns the edges of a picture, and 1 at the steps of its depth, ``[h, w]`` each, for cells of so many pixels."""
    seen = picture.read(picture.size)
    depth = seen.depth[0].numpy()[::cell, ::cell]
    grey = ndimage.uniform_filter(seen.images[0].mean(0).numpy() * 255, cell)[::cell, ::cell]
    slope = np.hypot(np.gradient(grey, axis=0), np.gradient(grey, axis=1))
    image = slope / (ndimage.uniform_filter(slope, _AROUND) + _NOISE)
    nearest, farthest = ndimage.minimum_filter(depth, 3), ndimage.maximum_filter(depth, 3)
    inner = (slice(_REACH, -_REACH), slice(_REACH, -_REACH))
    steps = np.zeros(depth.shape, np.float32)
    steps[inner] = ((nearest > 0) & (farthest > _STEP * nearest))[inner]
    return image.astype(np.float32), steps
