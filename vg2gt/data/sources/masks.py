"""Mask files: finds the mask of an image, and combines and resizes masks.

Masks are in a folder ``masks`` (or ``mask``, in any case), or next to their images as ``NAME_mask.png``.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from vg2gt.data.sources.parsing import MASK_FOLDERS, OTHER_FOLDERS, PHOTO_SUFFIXES, is_image_folder
from vg2gt.io.errors import DataError, some
from vg2gt.io.image_files import Size

log = logging.getLogger(__name__)

FOLDER = "masks"
_FOLDERS = ("masks", "mask")
_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
_MARKS = ("_mask", ".mask")  # between the name of an image and the suffix of its mask
_LEVELS = 5  # folders above an image in which its masks are looked for


class AmbiguousMaskError(DataError):
    """A mask file may belong to several images."""


def mask_folder(folder: Path) -> Path | None:
    """Finds the folder of masks in a folder: ``masks`` or ``mask``, in any case; None if there is none."""
    if (folder / FOLDER).is_dir():
        return folder / FOLDER
    try:
        return _mask_folder(folder, folder.stat().st_mtime_ns)
    except OSError:  # a folder above the images that cannot be listed
        return None


@lru_cache(maxsize=256)
def _mask_folder(folder: Path, changed: int) -> Path | None:
    """Looks a folder of masks up; another time ``changed`` of the folder invalidates the cache."""
    with os.scandir(folder) as entries:
        found = [entry.name for entry in entries if entry.name.lower() in _FOLDERS and entry.is_dir()]
    return folder / min(found, key=lambda name: (_FOLDERS.index(name.lower()), name)) if found else None


def _mask_of(folder: Path, name: str) -> Path | None:
    """Finds the mask of an image: ``NAME.png`` as in COLMAP, the name with another suffix, or the same name.

    ``_mask`` or ``.mask`` may be before the suffix.

    Args:
        folder: folder of masks.
        name: name of the image, relative to the image folder.
    """
    image = folder / name
    return _named(image.parent, (*_candidates(image, ("", *_MARKS)), image.name))


def _candidates(image: Path, marks: Sequence[str]) -> Iterator[str]:
    """Yields the names that an image's mask can have in the folder of the image, with one of the marks."""
    for mark in marks:
        for suffix in _SUFFIXES:
            yield image.name + mark + suffix
            yield image.stem + mark + suffix


def _named(folder: Path, candidates: Iterable[str]) -> Path | None:
    """Finds the first of some files in a folder, in any case."""
    try:
        known = _names(folder, folder.stat().st_mtime_ns)
    except OSError:  # missing, or it cannot be listed
        return None
    return next((folder / known[key] for name in candidates for key in (name, name.lower()) if key in known), None)


@lru_cache(maxsize=256)
def _names(folder: Path, changed: int) -> Mapping[str, str]:
    """Returns the files of a folder by their names and these in lower case; another ``changed`` invalidates it."""
    with os.scandir(folder) as entries:
        names = [entry.name for entry in entries if entry.is_file()]
    return {name.lower(): name for name in names} | {name: name for name in names}


def image_of_mask(path: Path) -> Path | None:
    """Returns the image that a file next to it is the mask of, by its name ``NAME_mask.png``; None if there is none."""
    return image_beside(path, _MARKS)


def image_beside(path: Path, marks: Sequence[str]) -> Path | None:
    """Returns the image ``NAME.*`` that a file ``NAME_mask.png`` belongs to; None if there is none.

    Args:
        path: the file.
        marks: what can be between the image's name and the suffix, in lower case.
    """
    mark = next((each for each in marks if path.stem.lower().endswith(each)), None)
    if mark is None:
        return None
    image = path.with_name(path.stem[: -len(mark)])
    if image.suffix.lower() in PHOTO_SUFFIXES and image.is_file():
        return image
    return _same_stem(image.with_name(f"{image.name}.x"))


def _next_to(image: Path) -> Path | None:
    """Finds the mask in an image's folder, ``NAME_mask.png``."""
    mask = _named(image.parent, _candidates(image, _MARKS))
    if mask is not None:
        _check_owner(mask, image.parent, (image.name,), 0)
    return mask


def mask_beside(image: Path) -> Path | None:
    """Finds the mask of an image in a folder ``masks`` next to it or up to four folders higher, or next to the image.

    ``A/images/front/1.jpg`` has the mask ``A/masks/front/1.png``. ``A/masks/1.png`` is also taken, unless other folders
    next to ``front`` have an image of that name.

    Raises:
        AmbiguousMaskError: if the mask may be that of another image of the same name.
    """
    path = image.absolute()
    for folder in path.parents[:_LEVELS]:
        parts = path.relative_to(folder).parts
        masks = mask_folder(folder)
        if masks is None:
            continue
        for dropped in range(len(parts) if len(parts) < 3 or is_image_folder(parts[0]) else 1):
            mask = _mask_of(masks, "/".join(parts[dropped:]))
            if mask is not None:
                _check_owner(mask, folder, parts, dropped)
                return mask
    return _next_to(path)


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
    if not mask.name.startswith(own.name):
        other = other or _same_stem(own, own.suffix)
    if other is not None:
        better = Path(FOLDER, *[part for part in parts[:-1] if not is_image_folder(part)], f"{own.name}.png")
        names = f"{own.relative_to(folder)} or of {other.relative_to(folder)}"
        raise AmbiguousMaskError(f"{mask} may be the mask of {names}: name the masks {better} and so on")


def _same_stem(image: Path, but: str = "") -> Path | None:
    """Returns an image of the same name with any ending, other than ``but``; None if there is none."""
    endings = [each for suffix in PHOTO_SUFFIXES for each in (suffix, suffix.upper()) if each.lower() != but.lower()]
    return next((found for ending in endings if (found := image.with_suffix(ending)).is_file()), None)


def find_masks(
    folder: Path, names: Mapping[int, str], images: Mapping[int, Path], where: str, known: Mapping[int, Path]
) -> dict[int, Path]:
    """Finds the masks of images by frame number. If any has one, warns about images without.

    Args:
        folder: folder of masks; need not exist.
        names: image names by frame number, relative to the image folder.
        images: image files by frame number; masks are found from there (:func:`mask_beside`), or else by name.
        where: the scene, for the message.
        known: masks that a file of the scene names.

    Raises:
        AmbiguousMaskError: if a mask may be that of another image of the same name.
    """
    folder = mask_folder(folder.parent) or folder
    found = {i: known.get(i) or mask_beside(images[i]) or _mask_of(folder, name) for i, name in names.items()}
    if not folder.is_dir() and not any(found.values()):
        warn_of_unused({folder.parent})
        return {}
    lacking = [names[number] for number, path in found.items() if path is None]
    warn_without_mask(lacking, len(names), f"{folder} of {where}")
    return {number: path for number, path in found.items() if path is not None}


def warn_without_mask(lacking: Sequence[str], count: int, folder: str) -> None:
    """Warns about ``lacking`` of ``count`` images, if any, that have no mask in a folder of masks."""
    if lacking:
        said = "%d of %d images have no mask in %s; all their pixels are used: %s"
        log.warning(said, len(lacking), count, folder, some(lacking))


def warn_of_unused(folders: Iterable[Path]) -> None:
    """Warns about folders in the given ones that hold masks by their names, none of which is used."""
    places = sorted(place for folder in folders for place in folder.iterdir())
    unused = [str(each) for each in places if MASK_FOLDERS.fullmatch(each.name) and each.is_dir()]
    if unused:
        log.warning("not used as masks: %s (masks are in %s/, with the names of their images)", some(unused), FOLDER)


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
