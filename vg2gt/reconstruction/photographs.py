"""Reads the photographs of a scene at their own size, for refinement."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.data.transforms import covering_size, photo_intrinsics, resize_to_cover, to_bytes
from vg2gt.geometry.cameras import crop_intrinsics, invert_rigid, resize_intrinsics
from vg2gt.inputs.pictures import Picture
from vg2gt.monitor import Monitor
from vg2gt.refinement import Photographs
from vg2gt.types import Cameras

if TYPE_CHECKING:
    from vg2gt.reconstruction.scene import Scene
    from vg2gt.refinement import FullSizeOptions, RefineOptions

_LARGER = 1.25  # factor from the working size to that of the photographs from which these are refined on their own


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


def of_full_size(scene: Scene, options: RefineOptions) -> FullSizeOptions | None:
    """Returns the options of the second stage; None without one, or if the photographs show no more than the views."""
    if options.full is None or not scene.pictures:
        return None
    size = full_size(scene.pictures, scene.cameras.size, options.full.size)
    return options.full if max(size) >= _LARGER * max(scene.cameras.size) else None


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


def sparse_points(scene: Scene) -> tuple[Tensor, Tensor]:
    """Returns the points of structure from motion that a scene's views observe.

    Returns:
        Positions ``[N, 3]`` in the scene's frame and colours ``[N, 3]`` in [0, 1], means over the views; N is 0 if the
        pictures have no points.
    """
    empty = torch.zeros(0, device=scene.images.device)
    numbers, found = [empty.long()], [empty.new_zeros(0, 6)]
    for view, picture in enumerate(scene.pictures):
        if picture.points is None or scene.frame is None:
            continue
        places, depth = (torch.from_numpy(each).to(empty) for each in (picture.points.places, picture.points.depth))
        own = scene.cameras.intrinsics[0, view]
        whole = photo_intrinsics(own, scene.cameras.size, picture.size)  # of the picture, of which the view is a crop
        pixels = places * places.new_tensor(picture.size[::-1]) - 0.5
        tangent = (pixels - whole[:2, 2]) / whole[[0, 1], [0, 1]]
        shown = (tangent * own[[0, 1], [0, 1]] + own[:2, 2] + 0.5) / places.new_tensor(scene.cameras.size[::-1])
        local = F.pad(tangent, (0, 1), value=1.0) * (depth[:, None] / scene.frame.scale)
        pose = invert_rigid(scene.cameras.world_to_camera[0, view])
        grid = (2 * shown - 1)[None, None]
        colors = F.grid_sample(scene.images[view : view + 1], grid, align_corners=False)[0, :, 0].T
        inside = ((shown >= 0) & (shown < 1)).all(1)
        numbers.append(torch.from_numpy(picture.points.numbers).to(empty.device)[inside])
        found.append(torch.cat((local @ pose[:3, :3].T + pose[:3, 3], colors), 1)[inside])
    rows, counts = torch.cat(numbers).unique(return_inverse=True, return_counts=True)[1:]
    means = empty.new_zeros(len(counts), 6).index_add_(0, rows, torch.cat(found)) / counts[:, None]
    return means[:, :3], means[:, 3:]
