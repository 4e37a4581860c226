"""Pictures of any size brought to one working size, with what is known of their cameras."""

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
_FEWEST_POINTS = 20  # observations of sparse points from which a range is told
_OUTLIERS, _NEARER, _FARTHER = 1, 0.8, 1.4  # percent left out at either end, widening


@dataclass(frozen=True)
class Views:
    """The input of a reconstruction.

    Attributes:
        images: ``[V, 3, H, W]`` float32 in [0, 1], on the CPU.
        names: one per view, unique.
        kept: share of each picture's area that is in its image; the rest was cropped.
        hints: what the data know, on the CPU: the order of the pictures at least.
        mask: ``[V, H, W]`` float32 in [0, 1], how much each pixel counts (alpha, mask images); None: all count.
        pictures: where the images come from, one per view.
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
    """The ``(height, width)`` to which all pictures are brought, in multiples of the patch size.

    The shape is the geometric mean of the pictures' shapes, which crops mixed ones the least.

    Args:
        sizes: the pictures' ``(height, width)``.
        patch: the backend's patch size.
        device: type of the device that computes; decides the default.
        size: the longer side in pixels (rounded down to patches), or exactly (height, width); None: 518 on a GPU, 280
            on a CPU, but not more than the pictures have.

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
    """Decodes pictures one by one; each is resized to cover the working size and cropped at its centre.

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
            "%d of %d images have another shape than %dx%d and lose more than a quarter at their borders, the first is "
            "%s; reconstruct images of one shape together, or choose another size",
            len(much), len(pictures), size[0], size[1], much[0],
        )  # fmt: skip
    joined = Frames.concatenate(frames)
    mask = None if joined.mask is None else joined.mask[None]
    hints = replace(_hints(pictures, joined, size), mask=mask)
    names = tuple(picture.name for picture in pictures)
    return Views(joined.images, names, kept, hints, joined.mask, tuple(pictures))


def photo_of(camera: NamedCamera, picture: Picture) -> Photo:
    """The camera of a view's whole photograph, from that of the view (the reverse of ``resize_to_cover``)."""
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
    """The order of the pictures, and what a recording knows if all are from one."""
    source, order = source_of(pictures), torch.arange(len(pictures))[None]
    if not source:
        return Hints(frame_ids=order)
    has_depth = all(picture.has_depth for picture in pictures)
    cameras = Cameras(given_poses(pictures)[None], frames.intrinsics[None], size)
    depth = frames.depth[None] if has_depth else None
    return Hints(depth, cameras, (source,), order, depth_range(pictures))


def source_of(pictures: Sequence[Picture]) -> str:
    """Where all pictures' cameras come from; empty if any has none.

    Raises:
        ValueError: if they come from several recordings, whose worlds have nothing to do with each other.
    """
    sources = {picture.source for picture in pictures}
    if "" in sources:
        return ""
    if len(sources) > 1:
        raise ValueError(f"cameras of several recordings cannot be mixed: {', '.join(sorted(sources))}; give one")
    return sources.pop()


def given_poses(pictures: Sequence[Picture]) -> Tensor:
    """Given poses ``[V, 4, 4]`` about the first camera's place if they are map coordinates, too long for float32."""
    poses = np.stack([np.eye(4) if picture.pose is None else picture.pose for picture in pictures])
    shift = np.eye(4)
    shift[:3, 3] = -poses[0, :3, :3].T @ poses[0, :3, 3]
    far = np.abs(poses[:, :3, 3]).max() > 1e3 * np.abs((poses @ shift)[:, :3, 3]).max()
    return torch.from_numpy(poses @ shift if far else poses).float()


def depth_range(pictures: Sequence[Picture]) -> Tensor | None:
    """Near and far ``[1, 2]`` of what the pictures see, from their sparse points; None where there are too few.

    The range of all but 1 % of the observed points at either end, widened: points lie where there is texture, so that
    floors before the camera and bare walls behind are missed. The plane sweep searches beyond it.
    """
    known = [picture.point_depths for picture in pictures if picture.point_depths is not None]
    depths = np.concatenate(known) if known else np.zeros(0)
    if len(depths) < _FEWEST_POINTS:
        return None
    near, far = np.percentile(depths, (_OUTLIERS, 100 - _OUTLIERS))
    return torch.tensor([[near * _NEARER, far * _FARTHER]], dtype=torch.float32)
