"""Photographs of a scene's views at their own size, dealt in crops."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.geometry.cameras import resize_intrinsics
from vg2gt.refinement.options import Observations
from vg2gt.types import Cameras, TensorRecord


@dataclass(frozen=True)
class Photographs(TensorRecord):
    """Photographs of V views at their own size.

    Attributes:
        images: ``[V, 3, H, W]`` uint8.
        intrinsics: ``[V, 3, 3]`` at this size.
        mask: ``[V, H, W]`` uint8 pixel weights, 255: full; None: all pixels count.
    """

    images: Tensor
    intrinsics: Tensor
    mask: Tensor | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return (self.images.shape[-2], self.images.shape[-1])

    def bounds(self, view: int) -> list[tuple[int, int]]:
        """Returns first row and row after the last, then first column and column after the last, that are not masked.

        The whole image if all pixels are masked.
        """
        if self.mask is None or not self.mask[view].any():
            return [(0, side) for side in self.size]
        used = (self.mask[view].any(axis).nonzero() for axis in (1, 0))
        return [(int(found[0]), int(found[-1]) + 1) for found in used]

    def halved(self) -> Photographs:
        """Returns the photographs at half the size, each pixel the mean of four; an odd last row or column is lost."""

        def half(images: Tensor) -> Tensor:  # one by one, to bound memory
            return torch.stack([F.avg_pool2d(image.float(), 2).round().to(torch.uint8) for image in images])

        mask = None if self.mask is None else half(self.mask[:, None])[:, 0]
        return Photographs(half(self.images), resize_intrinsics(self.intrinsics, 0.5, 0.5), mask)

    def cameras(self, poses: Cameras) -> Cameras:
        """Returns the cameras of the photographs, with the poses of ``poses`` (B = 1)."""
        return Cameras(poses.world_to_camera, self.intrinsics[None], self.size)


@dataclass(frozen=True)
class Crop:
    """A part of one photograph.

    Attributes:
        view: index of the photograph.
        top: first row.
        left: first column.
        size: height and width in pixels.
    """

    view: int
    top: int
    left: int
    size: tuple[int, int]

    def camera(self, cameras: Cameras) -> Cameras:
        """Returns the crop's camera from those of the photographs: the principal point moves."""
        one = slice(self.view, self.view + 1)
        corner = cameras.intrinsics.new_zeros(3, 3)
        corner[0, 2], corner[1, 2] = self.left, self.top
        return Cameras(cameras.world_to_camera[:, one], cameras.intrinsics[:, one] - corner, self.size)

    def observations(self, photographs: Photographs, seen: Observations, intrinsics: Tensor) -> Observations:
        """Returns what is known of the crop's pixels.

        Args:
            photographs: the photographs.
            seen: observations of the views at the working size; depth comes from their nearest pixel.
            intrinsics: ``[V, 3, 3]`` of the views at the working size.
        """
        one = slice(self.view, self.view + 1)
        window = (slice(self.top, self.top + self.size[0]), slice(self.left, self.left + self.size[1]))
        images = photographs.images[(one, slice(None), *window)].to(seen.images.dtype) / 255
        mask = None if photographs.mask is None else photographs.mask[(one, *window)].to(images.dtype) / 255
        known = []
        for axis, (first, side) in enumerate(((self.left, self.size[1]), (self.top, self.size[0]))):
            pixels = torch.arange(first, first + side, device=images.device)
            matrix, small = photographs.intrinsics[self.view], intrinsics[self.view]
            tangent = (pixels - matrix[axis, 2]) / matrix[axis, axis]
            known.append((tangent * small[axis, axis] + small[axis, 2]).round().long())
        columns, rows = known
        height, width = seen.depth.shape[-2:]
        inside = ((rows >= 0) & (rows < height))[:, None] & ((columns >= 0) & (columns < width))
        grid = (self.view, rows.clamp(0, height - 1)[:, None], columns.clamp(0, width - 1))
        depth = torch.where(inside, seen.depth[grid], 0.0)[None]
        return Observations(images, depth, seen.depth_conf[grid][None], mask)


class CropOrder:
    """Deals crops of random views: each view once before any repeats, each pixel of a view about equally often.

    Crops of masked photographs keep to the rectangle around what is not masked.

    Args:
        photographs: the photographs.
        side: longest side of a crop in pixels.
        views: ``[N]`` views to deal.
        seed: random seed.
    """

    def __init__(self, photographs: Photographs, side: int, views: Tensor, seed: int) -> None:
        self.size, self.views = photographs.size, views
        self.crop = (min(side, self.size[0]), min(side, self.size[1]))
        self._bounds = {view: photographs.bounds(view) for view in views.tolist()}
        self._generator = torch.Generator().manual_seed(seed)
        self._hand: list[int] = []

    def deal(self) -> Crop:
        """Returns the next crop."""
        if not self._hand:
            order = torch.randperm(len(self.views), generator=self._generator)
            self._hand = self.views[order].tolist()
        view = self._hand.pop()
        top, left = map(self._start, self.size, self.crop, self._bounds[view])
        return Crop(view, top, left, self.crop)

    def _start(self, whole: int, part: int, bounds: tuple[int, int]) -> int:
        """Returns the first pixel of a crop along one axis, whose middle is drawn; the border moves it inside."""
        middle = bounds[0] + float(torch.rand((), generator=self._generator)) * (bounds[1] - bounds[0])
        return min(max(round(middle - part / 2), 0), whole - part)


def whole_views(photographs: Photographs, views: Tensor) -> list[Crop]:
    """Returns the crops that are whole photographs."""
    return [Crop(view, 0, 0, photographs.size) for view in views.tolist()]
