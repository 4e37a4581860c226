"""Mask files: finds the mask of an image, and combines and resizes masks."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from vg2gt.data.sources.parsing import OTHER_FOLDERS, PHOTO_SUFFIXES, is_image_folder
from vg2gt.io.errors import DataError, some
from vg2gt.io.image_files import Size

log = logging.getLogger(__name__)

FOLDER = "masks"
_ENDINGS = tuple(each for ending in (".png", ".jpg", ".jpeg", ".bmp") for each in (ending, ending.upper()))
_LEVELS = 5  # folders above an image in which its masks are looked for


class AmbiguousMaskError(DataError):
    """A mask file may belong to several images."""


def mask_of(folder: Path, name: str) -> Path | None:
    """Finds the mask of an image: ``NAME.png`` as in COLMAP, the name with another suffix, or the same name.

    Args:
        folder: folder of masks.
        name: name of the image, relative to the image folder.
    """
    stem = folder / name
    candidates = [Path(f"{stem}.png"), Path(f"{stem}.PNG"), *(stem.with_suffix(ending) for ending in _ENDINGS), stem]
    return next((path for path in candidates if path.is_file()), None)


def mask_beside(image: Path) -> Path | None:
    """Finds the mask of an image in a folder ``masks`` next to it or up to four folders higher.

    ``A/images/front/1.jpg`` has the mask ``A/masks/front/1.png``. ``A/masks/1.png`` is also taken, unless other folders
    next to ``front`` have an image of that name.

    Raises:
        AmbiguousMaskError: if the mask may be that of another image of the same name.
    """
    path = image.absolute()
    for folder in path.parents[:_LEVELS]:
        parts = path.relative_to(folder).parts
        if not (folder / FOLDER).is_dir():
            continue
        for dropped in range(len(parts) if len(parts) < 3 or is_image_folder(parts[0]) else 1):
            mask = mask_of(folder / FOLDER, "/".join(parts[dropped:]))
            if mask is not None:
                _check_owner(mask, folder, parts, dropped)
                return mask
    return None


def _check_owner(mask: Path, folder: Path, parts: Sequence[str], dropped: int) -> None:
    """Checks that a mask found without the first ``dropped`` parts of an image's path fits no other image.

    Raises:
        AmbiguousMaskError: if it does.
    """
    other = None
    for place, part in enumerate(parts[:dropped]):
        if is_image_folder(part):  # next to it are depth, reduced copies and the like
            continue
        above, rest = folder.joinpath(*parts[:place]), Path(*parts[place + 1 :])
        places = [each for each in above.iterdir() if each.is_dir() and each.name != part]
        places = [each for each in places if not OTHER_FOLDERS.fullmatch(each.name)]
        other = other or next((found for each in places if (found := _same_stem(each / rest))), None)
    own = folder.joinpath(*parts)
    if mask.stem != own.name and mask.name != own.name:
        other = other or _same_stem(own, own.suffix)
    if other is not None:
        better = Path(FOLDER, *[part for part in parts[:-1] if not is_image_folder(part)], f"{own.name}.png")
        names = f"{own.relative_to(folder)} or of {other.relative_to(folder)}"
        raise AmbiguousMaskError(f"{mask} may be the mask of {names}: name the masks {better} and so on")


def _same_stem(image: Path, but: str = "") -> Path | None:
    """Returns an image of the same name with any ending, other than ``but``; None if there is none."""
    endings = [each for suffix in PHOTO_SUFFIXES for each in (suffix, suffix.upper()) if each.lower() != but.lower()]
    return next((found for ending in endings if (found := image.with_suffix(ending)).is_file()), None)


def find_masks(folder: Path, names: Mapping[int, str], images: Mapping[int, Path], where: str) -> dict[int, Path]:
    """Finds the masks of images by frame number. If the folder exists, warns about images without a mask.

    Args:
        folder: folder of masks; need not exist.
        names: image names by frame number, relative to the image folder.
        images: image files by frame number; masks are found from there (:func:`mask_beside`), or else by name.
        where: the scene, for the message.

    Raises:
        AmbiguousMaskError: if a mask may be that of another image of the same name.
    """
    found = {number: mask_beside(images[number]) or mask_of(folder, name) for number, name in names.items()}
    if not folder.is_dir() and not any(found.values()):
        return {}
    lacking = [names[number] for number, path in found.items() if path is None]
    warn_without_mask(lacking, len(names), f"{folder} of {where}")
    return {number: path for number, path in found.items() if path is not None}


def warn_without_mask(lacking: Sequence[str], count: int, folder: str) -> None:
    """Warns about ``lacking`` of ``count`` images, if any, that have no mask in a folder of masks."""
    if lacking:
        said = "%d of %d images have no mask in %s; all their pixels are used: %s"
        log.warning(said, len(lacking), count, folder, some(lacking))


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
