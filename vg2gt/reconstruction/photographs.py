"""Reads the photographs of a scene at their own size, for refinement."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from vg2gt.data.transforms import resize_to_cover, to_bytes
from vg2gt.geometry.cameras import crop_intrinsics, resize_intrinsics
from vg2gt.inputs.inputs import covering_size, photo_intrinsics
from vg2gt.inputs.pictures import Picture
from vg2gt.monitor import Monitor
from vg2gt.refinement import Photographs
from vg2gt.types import Cameras


def full_size(pictures: Sequence[Picture], working: tuple[int, int], longest: int) -> tuple[int, int]:
    """Returns the common ``(height, width)`` at which photographs are refined, of the shape of the working size.

    Args:
        pictures: the photographs.
        working: working size of their views.
        longest: longer side in pixels, at most; it is also at most that of the median photograph.
    """
    sides = sorted(max(picture.size) for picture in pictures)
    factor = max(1.0, min(longest, sides[len(sides) // 2]) / max(working))
    return (round(working[0] * factor), round(working[1] * factor))


def load_photographs(pictures: Sequence[Picture], cameras: Cameras, longest: int, monitor: Monitor) -> Photographs:
    """Decodes photographs one by one; each is resized to cover the common size and centre-cropped, as its view was.

    Args:
        pictures: photographs of V views.
        cameras: cameras of the views (B = 1) at the working size.
        longest: see :func:`full_size`.
        monitor: shows the progress.

    Returns:
        The photographs, on the CPU, as bytes: three for each pixel.

    Raises:
        ValueError: if a photograph cannot be read, naming it.
    """
    size = full_size(pictures, cameras.size, longest)
    images = torch.empty(len(pictures), 3, *size, dtype=torch.uint8)
    masks = None
    intrinsics = torch.empty(len(pictures), 3, 3)
    with monitor.stage("load photographs", len(pictures)) as advance:
        for view, picture in enumerate(pictures):
            frame = resize_to_cover(picture.read(size), size)
            images[view] = to_bytes(frame.images[0])
            if frame.mask is not None:
                masks = torch.full((len(pictures), *size), 255, dtype=torch.uint8) if masks is None else masks
                masks[view] = to_bytes(frame.mask[0])
            own = photo_intrinsics(cameras.intrinsics[0, view].double().cpu(), cameras.size, picture.size)
            covering, (top, left) = covering_size(picture.size, size)
            own = resize_intrinsics(own, covering[1] / picture.size[1], covering[0] / picture.size[0])
            intrinsics[view] = crop_intrinsics(own, left, top).float()
            advance()
    return Photographs(images, intrinsics, masks)
