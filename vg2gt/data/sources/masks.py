"""Mask files: finds the mask of an image, and combines and resizes masks."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from vg2gt.io.image_files import Size

log = logging.getLogger(__name__)

FOLDER = "masks"
_ENDINGS = tuple(each for ending in (".png", ".jpg", ".jpeg", ".bmp") for each in (ending, ending.upper()))


def mask_of(folder: Path, name: str) -> Path | None:
    """Finds the mask of an image: ``NAME.png`` as in COLMAP, the name with another suffix, or the same name.

    Args:
        folder: folder of masks.
        name: name of the image, relative to the image folder.
    """
    stem = folder / name
    candidates = [Path(f"{stem}.png"), Path(f"{stem}.PNG"), *(stem.with_suffix(ending) for ending in _ENDINGS), stem]
    return next((path for path in candidates if path.is_file()), None)


def find_masks(folder: Path, names: Mapping[int, str], where: str) -> dict[int, Path]:
    """Finds the masks of images by frame number. If the folder exists, warns about images without a mask.

    Args:
        folder: folder of masks; need not exist.
        names: image names by frame number, relative to the image folder.
        where: the scene, for the message.
    """
    if not folder.is_dir():
        return {}
    found = {number: mask_of(folder, name) for number, name in names.items()}
    warn_without_mask([names[number] for number, path in found.items() if path is None], len(names), folder, where)
    return {number: path for number, path in found.items() if path is not None}


def warn_without_mask(lacking: Sequence[str], count: int, folder: Path, where: str) -> None:
    """Warns about ``lacking`` of ``count`` images, if any, that have no mask in a folder of masks."""
    if lacking:
        log.warning(
            "%s: %d of %d images have no mask in %s; all their pixels are used: %s",
            where, len(lacking), count, folder, ", ".join(lacking[:10]),
        )  # fmt: skip


def joined_masks(masks: Sequence[NDArray[np.float32] | None]) -> NDArray[np.float32] | None:
    """Multiplies the masks of an image, at the size of the first; None if there are none."""
    known = [mask for mask in masks if mask is not None]
    if not known:
        return None
    size = (known[0].shape[0], known[0].shape[1])
    return np.prod([resized_mask(mask, size) for mask in known], 0, dtype=np.float32)


def resized_mask(mask: NDArray[np.float32], size: Size) -> NDArray[np.float32]:
    """Resizes a mask ``[h, w]`` to ``(height, width)``, bilinearly."""
    if mask.shape == tuple(size):
        return mask
    return np.array(Image.fromarray(mask).resize((size[1], size[0]), Image.Resampling.BILINEAR))
