"""Loads pictures of any size at one working size, with what is known about their cameras."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from vg2gt.data.base import Frames
from vg2gt.data.transforms import resize_to_cover
from vg2gt.geometry.cameras import crop_intrinsics, resize_intrinsics
from vg2gt.io.cameras_json import NamedCamera, Photo
from vg2gt.reconstruction.monitor import Monitor
from vg2gt.reconstruction.pictures import Picture, decoded
from vg2gt.types import Cameras, Hints

log = logging.getLogger(__name__)

LONGER_SIDE = {"cuda": 518, "cpu": 280}  # pixels, by device; foundation models are trained at about 518
_MUCH_LOST = 0.25
_FEWEST_POINTS = 20  # minimum observations of sparse points for a depth range
_OUTLIERS, _NEARER, _FARTHER = 1, 0.8, 1.4  # percent cut at either end, widening factors


@dataclass(frozen=True)
class Views:
    """The input of a reconstruction.

    Attributes:
        images: ``[V, 3, H, W]`` float32 in [0, 1], on the CPU.
        names: one per view, unique.
        kept: share of each picture's area that is left after cropping.
        hints: known inputs, on the CPU: at least the order of the pictures.
        mask: ``[V, H, W]`` float32 in [0, 1], pixel weights (alpha, mask images); None: all pixels count.
        pictures: source pictures, one per view.
    """

    images: Tensor
    names: tuple[str, ...]
    kept: tuple[float, ...]
    hints: Hints
    mask: Tensor | None = None
    pictures: tuple[Picture, ...] = ()


def working_size(
    sizes: Sequence[tuple[int, int]], patch: int, device: str, size: int | tuple[int, int] | None = None
) -> tuple[int, int]:
    """Returns the common ``(height, width)`` of all images, in multiples of the patch size.

    The aspect ratio is the geometric mean of the pictures' ratios, which crops mixed shapes the least.

    Args:
        sizes: ``(height, width)`` of the pictures.
        patch: patch size of the backend.
        device: type of the compute device; decides the default.
        size: longer side in pixels (rounded down to patches), or exact (height, width); None: 518 on a GPU, 280 on a
            CPU, but at most the median longer side of the pictures.

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
    longer = max(size or min(LONGER_SIDE.get(device, LONGER_SIDE["cuda"]), longest), patch) // patch
    shorter = max(1, round(longer * min(shape, 1 / shape)))
    return (longer * patch, shorter * patch) if shape > 1 else (shorter * patch, longer * patch)


def load_views(pictures: Sequence[Picture], size: tuple[int, int], monitor: Monitor) -> Views:
    """Decodes pictures one by one; each is resized to cover the working size and centre-cropped.

    Raises:
        ValueError: if a picture cannot be read, naming it.
    """
    frames: list[Frames] = []
    with monitor.stage("load images", len(pictures)) as advance:
        for number in range(len(pictures)):
            frames.append(resize_to_cover(decoded(pictures, number, size), size))
            advance()
    kept = tuple(_kept(picture.size, size) for picture in pictures)
    much = [picture.name for picture, share in zip(pictures, kept, strict=True) if share < 1 - _MUCH_LOST]
    if much:
        log.warning(
            "%d of %d images have a different aspect ratio than %dx%d and lose more than a quarter to cropping (first: "
            "%s); reconstruct images of one shape together, or choose another size",
            len(much), len(pictures), size[0], size[1], much[0],
        )  # fmt: skip
    joined = Frames.concatenate(frames)
    mask = None if joined.mask is None else joined.mask[None]
    hints = replace(_hints(pictures, joined, size), mask=mask)
    names = tuple(picture.name for picture in pictures)
    return Views(joined.images, names, kept, hints, joined.mask, tuple(pictures))


def photo_of(camera: NamedCamera, picture: Picture) -> Photo:
    """Returns the camera of a view's whole photograph from the view's camera (inverse of ``resize_to_cover``)."""
    name = camera.name if picture.path is None else picture.path.name
    height, width = picture.size
    scale = max(camera.height / height, camera.width / width)
    covering = [
        max(least, math.floor(side * scale + 0.5)) for least, side in ((camera.height, height), (camera.width, width))
    ]
    room = ((covering[0] - camera.height) // 2, (covering[1] - camera.width) // 2)
    matrix = crop_intrinsics(torch.from_numpy(camera.intrinsics), -room[1], -room[0])
    matrix = resize_intrinsics(matrix, width / covering[1], height / covering[0])
    return Photo(name, width, height, matrix.numpy(), picture.lens)


def _kept(size: tuple[int, int], window: tuple[int, int]) -> float:
    ratio = (size[0] / size[1]) / (window[0] / window[1])
    return min(ratio, 1 / ratio)


def _hints(pictures: Sequence[Picture], frames: Frames, size: tuple[int, int]) -> Hints:
    """Returns the order of the pictures and, if all are from one recording, its cameras and depth."""
    source, order = source_of(pictures), torch.arange(len(pictures))[None]
    if not source:
        return Hints(frame_ids=order)
    has_depth = all(picture.has_depth for picture in pictures)
    cameras = Cameras(given_poses(pictures)[None], frames.intrinsics[None], size)
    depth = frames.depth[None] if has_depth else None
    return Hints(depth, cameras, (source,), order, depth_range(pictures))


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


def given_poses(pictures: Sequence[Picture]) -> Tensor:
    """Returns given poses ``[V, 4, 4]``; map coordinates too large for float32 are shifted to the first camera."""
    poses = np.stack([np.eye(4) if picture.pose is None else picture.pose for picture in pictures])
    shift = np.eye(4)
    shift[:3, 3] = -poses[0, :3, :3].T @ poses[0, :3, 3]
    far = np.abs(poses[:, :3, 3]).max() > 1e3 * np.abs((poses @ shift)[:, :3, 3]).max()
    return torch.from_numpy(poses @ shift if far else poses).float()


def depth_range(pictures: Sequence[Picture]) -> Tensor | None:
    """Returns near and far ``[1, 2]`` of the pictures' sparse points; None if there are too few.

    The range leaves out 1 % of the observed points at either end and is then widened: points lie on texture, so floors
    in front of the camera and bare walls behind have none. The plane sweep also searches beyond this range.
    """
    known = [picture.point_depths for picture in pictures if picture.point_depths is not None]
    depths = np.concatenate(known) if known else np.zeros(0)
    if len(depths) < _FEWEST_POINTS:
        return None
    near, far = np.percentile(depths, (_OUTLIERS, 100 - _OUTLIERS))
    return torch.tensor([[near * _NEARER, far * _FARTHER]], dtype=torch.float32)
