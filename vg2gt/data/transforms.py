"""Resizing and cropping of frames together with their intrinsics."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from vg2gt.data.base import Frames
from vg2gt.geometry.cameras import crop_intrinsics, resize_intrinsics


def resize(frames: Frames, size: tuple[int, int]) -> Frames:
    """Resizes frames to exactly ``size`` (height, width).

    Colour is antialiased (triangle filter as wide as a target pixel). Dense depth uses the nearest pixel, because a
    mean across an edge would be a point in mid-air. Sparse depth is moved point by point; if several points fall into
    a pixel, the one nearest to the camera is kept.
    """
    height, width = frames.depth.shape[-2:]
    if (height, width) == tuple(size):
        return frames
    return replace(
        frames,
        images=resize_images(frames.images, size),
        depth=resize_depth(frames.depth, size, frames.sparse_depth),
        intrinsics=resize_intrinsics(frames.intrinsics, size[1] / width, size[0] / height),
        mask=None if frames.mask is None else resize_images(frames.mask[:, None], size)[:, 0],
    )


def resize_images(images: Tensor, size: tuple[int, int]) -> Tensor:
    """Resizes images ``[V, 3, H, W]``, antialiased."""
    if tuple(images.shape[-2:]) == tuple(size):
        return images
    return interpolate(images, size, mode="bilinear", antialias=True, align_corners=False).clamp(0, 1)


def resize_depth(depth: Tensor, size: tuple[int, int], sparse: bool = False) -> Tensor:
    """Resizes depth ``[V, H, W]`` by nearest pixel, or, if sparse, moves every point to the pixel it falls in."""
    views, height, width = depth.shape
    if (height, width) == tuple(size):
        return depth
    if not sparse:
        return interpolate(depth[:, None], size, mode="nearest-exact")[:, 0]  # [V, H', W']
    view, y, x = depth.nonzero(as_tuple=True)  # [P] each
    # A pixel with centre c falls into the new pixel floor((c + 1/2) scale).
    row = ((y + 0.5) * (size[0] / height)).long().clamp(max=size[0] - 1)
    column = ((x + 0.5) * (size[1] / width)).long().clamp(max=size[1] - 1)
    nearest = depth.new_full((views * size[0] * size[1],), torch.inf)  # [V H' W']
    nearest.scatter_reduce_(0, (view * size[0] + row) * size[1] + column, depth[view, y, x], "amin")
    return torch.where(nearest.isinf(), 0, nearest).reshape(views, *size)


def crop(frames: Frames, top: int, left: int, size: tuple[int, int]) -> Frames:
    """Crops the window of ``size`` (height, width) whose first pixel is (``top``, ``left``)."""

    def window(image: Tensor) -> Tensor:
        return image[..., top : top + size[0], left : left + size[1]].contiguous()

    return replace(
        frames,
        images=window(frames.images),
        depth=window(frames.depth),
        intrinsics=crop_intrinsics(frames.intrinsics, left, top),
        mask=None if frames.mask is None else window(frames.mask),
    )


def resize_to_cover(frames: Frames, size: tuple[int, int]) -> Frames:
    """Resizes frames until they cover ``size`` (height, width), keeping their aspect ratio, and crops the centre."""
    height, width = frames.depth.shape[-2:]
    # Rounding to whole pixels changes the two scales slightly; resize() applies the actual ones to the intrinsics.
    covering, (top, left) = covering_size((height, width), size)
    return crop(resize(frames, covering), top, left, size)


def covering_size(photo: tuple[int, int], size: tuple[int, int]) -> tuple[tuple[int, int], tuple[int, int]]:
    """Returns the size to which :func:`resize_to_cover` resizes a photograph; first row and column of its crop."""
    scale = max(size[0] / photo[0], size[1] / photo[1])
    height, width = (max(least, _whole(side * scale)) for least, side in zip(size, photo, strict=True))
    return (height, width), ((height - size[0]) // 2, (width - size[1]) // 2)


def photo_intrinsics(intrinsics: Tensor, size: tuple[int, int], photo: tuple[int, int]) -> Tensor:
    """Returns the intrinsics of a whole photograph from those of its view.

    Args:
        intrinsics: ``[3, 3]`` of the view.
        size: height and width of the view.
        photo: height and width of the photograph.
    """
    covering, (top, left) = covering_size(photo, size)
    return resize_intrinsics(crop_intrinsics(intrinsics, -left, -top), photo[1] / covering[1], photo[0] / covering[0])


def reduce_to_fit(frames: Frames, size: tuple[int, int]) -> Frames:
    """Shrinks frames until they just fit into ``size``, keeping their aspect ratio; smaller frames are unchanged."""
    height, width = frames.depth.shape[-2:]
    scale = min(size[0] / height, size[1] / width)
    if scale >= 1:
        return frames
    return resize(frames, (min(size[0], max(1, _whole(height * scale))), min(size[1], max(1, _whole(width * scale)))))


def _whole(length: float) -> int:
    return math.floor(length + 0.5)


def to_bytes(images: Tensor) -> Tensor:
    """Converts images in [0, 1] to uint8, rounded."""
    return (images * 255 + 0.5).to(torch.uint8)


def from_bytes(images: Tensor) -> Tensor:
    """Converts uint8 images to float32 in [0, 1]."""
    return images.to(torch.float32) / 255
