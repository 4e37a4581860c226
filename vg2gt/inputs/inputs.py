"""Loads pictures of any size at one working size, with what is known about their cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vg2gt.data.base import Frames
from vg2gt.data.transforms import photo_intrinsics, resize_to_cover
from vg2gt.geometry.cameras import crop_intrinsics
from vg2gt.inputs.pictures import Picture
from vg2gt.io.cameras_json import NamedCamera, Photo
from vg2gt.monitor import Monitor
from vg2gt.types import Cameras, Hints

_LONGER_SIDE = {"cuda": 518, "cpu": 392}  # pixels, by device; foundation models are trained at about 518
_MANY, _MANY_SIDE = 48, 280  # above this number of pictures, a CPU gets smaller ones
PADDED = 1e-3
"""Mask of padding: hardly any weight, but unlike 0 it does not say that nothing is there (:func:`without_padding`)."""
_FEWEST_POINTS = 20  # minimum observations of sparse points for a depth range
_OUTLIERS, _NEARER, _FARTHER = 1, 0.8, 1.4  # percent cut at either end, widening factors


@dataclass(frozen=True)
class Views:
    """The input of a reconstruction.

    Attributes:
        images: ``[V, 3, H, W]`` float32 in [0, 1], on the CPU.
        hints: known inputs, on the CPU: at least the order of the pictures.
        mask: ``[V, H, W]`` float32 in [0, 1], pixel weights (alpha, mask images); None: all pixels count.
    """

    images: Tensor
    hints: Hints
    mask: Tensor | None = None


def working_size(
    sizes: Sequence[tuple[int, int]], patch: int, device: str, size: int | tuple[int, int] | None = None
) -> tuple[int, int]:
    """Returns the common ``(height, width)`` of all images, in multiples of the patch size.

    The aspect ratio is the geometric mean of the pictures' ratios, which crops mixed shapes the least.

    Args:
        sizes: ``(height, width)`` of the pictures.
        patch: patch size of the backend.
        device: type of the compute device; decides the default.
        size: longer side in pixels (rounded down to patches), or exact (height, width); None: 518 on a GPU, 392 on a
            CPU (280 of more than 48 pictures), but at most the median longer side of the pictures.

    Raises:
        ValueError: if the size is smaller than a patch, or given exactly and not a multiple of the patch.
    """
    if isinstance(size, tuple):
        if min(size) < patch or any(side % patch for side in size):
            near = "x".join(str(max(round(side / patch), 1) * patch) for side in size)
            raise ValueError(f"size {size[0]}x{size[1]} is not a multiple of the patch size {patch}; try {near}")
        return size
    if size is not None and size < patch:
        raise ValueError(f"size {size} is smaller than one patch of {patch} pixels")
    shape = math.exp(sum(math.log(height / width) for height, width in sizes) / len(sizes))
    longest = sorted(max(pair) for pair in sizes)[len(sizes) // 2]
    usual = _LONGER_SIDE.get(device, _LONGER_SIDE["cuda"])
    if device == "cpu" and len(sizes) > _MANY:
        usual = _MANY_SIDE
    longer = max(size or min(usual, longest), patch) // patch
    shorter = max(1, round(longer * min(shape, 1 / shape)))
    return (longer * patch, shorter * patch) if shape > 1 else (shorter * patch, longer * patch)


def load_views(pictures: Sequence[Picture], size: tuple[int, int], monitor: Monitor) -> Views:
    """Decodes pictures one by one; each is resized to cover the working size and centre-cropped.

    Raises:
        ValueError: if a picture cannot be read, naming it.
    """
    frames: list[Frames] = []
    with monitor.stage("load images", len(pictures)) as advance:
        for picture in pictures:
            frames.append(resize_to_cover(picture.read(size), size))
            advance()
    joined = Frames.concatenate(frames)
    mask = None if joined.mask is None else joined.mask[None]
    source, hints = source_of(pictures), Hints(frame_ids=torch.arange(len(pictures))[None], mask=mask)
    if source:
        cameras = Cameras(given_poses(pictures, map_shift(pictures))[None], joined.intrinsics[None], size)
        depth = joined.depth[None] if all(picture.has_depth for picture in pictures) else None
        hints = Hints(depth, cameras, (source,), hints.frame_ids, depth_range(pictures), mask)
    images = joined.images if joined.mask is None else _cut_out(joined.images, joined.mask)
    return Views(images, hints, joined.mask)


def without_padding(mask: Tensor) -> Tensor:
    """Returns masks in which padding counts as seen, for what concludes from a mask that nothing is there."""
    return torch.where((mask - PADDED).abs() < PADDED / 2, 1.0, mask)


def _cut_out(images: Tensor, mask: Tensor) -> Tensor:
    """Returns images ``[V, 3, H, W]`` in which masks ``[V, H, W]`` of objects hide what is around them.

    It becomes white, as transparent pixels are, or depth would be found there by what the masks hide. Other masks,
    which show most of the image's border, stand for things in front of a scene that goes on behind them.
    """
    seen = without_padding(mask)
    border = torch.cat([seen[:, 0], seen[:, -1], seen[:, :, 0], seen[:, :, -1]], 1)
    hidden = (border <= 0.5).float().mean(1) > 0.5
    weights = torch.where(hidden[:, None, None], mask, 1.0)[:, None]
    return images * weights + (1 - weights)


def photo_of(camera: NamedCamera, picture: Picture) -> Photo:
    """Returns the camera of a view's whole photograph from the view's camera (inverse of ``resize_to_cover``)."""
    name = camera.name if picture.path is None else picture.path.name
    matrix = photo_intrinsics(torch.from_numpy(camera.intrinsics), (camera.height, camera.width), picture.size)
    (height, width), (rows, columns) = (picture.whole or picture).size, picture.size
    matrix = crop_intrinsics(matrix, (columns - width) // 2, (rows - height) // 2)
    return Photo(name, width, height, matrix.numpy(), picture.lens)


def source_of(pictures: Sequence[Picture]) -> str:
    """Returns the source of all pictures' cameras; empty if any has none.

    Raises:
        ValueError: if they come from several recordings, whose world frames are unrelated.
    """
    sources = {picture.source for picture in pictures}
    if "" in sources:
        return ""
    if len(sources) > 1:
        raise ValueError(f"cameras of several recordings cannot be mixed: {', '.join(sorted(sources))}; give one")
    return sources.pop()


def map_shift(pictures: Sequence[Picture]) -> NDArray[np.float64]:
    """Returns the translation ``[4, 4]`` to the first camera if map coordinates are too large for float32, else I."""
    poses = _poses(pictures)
    shift = np.eye(4)
    shift[:3, 3] = -poses[0, :3, :3].T @ poses[0, :3, 3]
    far = np.abs(poses[:, :3, 3]).max() > 1e3 * np.abs((poses @ shift)[:, :3, 3]).max()
    return shift if far else np.eye(4)


def given_poses(pictures: Sequence[Picture], shift: NDArray[np.float64]) -> Tensor:
    """Returns given poses ``[V, 4, 4]`` in the world that ``shift [4, 4]`` (:func:`map_shift`) maps to their own."""
    return torch.from_numpy(_poses(pictures) @ shift).float()


def _poses(pictures: Sequence[Picture]) -> NDArray[np.float64]:
    return np.stack([np.eye(4) if picture.pose is None else picture.pose for picture in pictures])


def depth_range(pictures: Sequence[Picture]) -> Tensor | None:
    """Returns near and far ``[1, 2]`` of the pictures' sparse points; None if there are too few.

    The range leaves out 1 % of the observed points at either end and is then widened: points lie on texture, so floors
    in front of the camera and bare walls behind have none.
    """
    known = [picture.point_depths for picture in pictures if picture.point_depths is not None]
    depths = np.concatenate(known) if known else np.zeros(0)
    if len(depths) < _FEWEST_POINTS:
        return None
    near, far = np.percentile(depths, (_OUTLIERS, 100 - _OUTLIERS))
    return torch.tensor([[near * _NEARER, far * _FARTHER]], dtype=torch.float32)
