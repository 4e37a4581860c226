"""Images that cannot be read, or show nothing, are left out by name."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import TypeVar

from vg2gt.io.errors import DataError, some
from vg2gt.io.image_files import is_damaged

log = logging.getLogger(__name__)

T = TypeVar("T")


def readable(files: Iterable[Path], read: Callable[[Path], T], faults: dict[str, str]) -> dict[Path, T]:
    """Returns what ``read`` makes of image files; what is wrong with damaged ones is added to ``faults``, by path."""
    found: dict[Path, T] = {}
    for file in files:
        try:
            found[file] = read(file)
        except DataError as error:
            if not is_damaged(file):
                raise
            faults[str(file)] = reason_of(error)
    return found


def read_each(files: Collection[Path], read: Callable[[Path], T]) -> list[T]:
    """Returns what ``read`` makes of each image file; damaged ones are left out and named in a warning.

    Raises:
        DataError: if no image is left, or ``read`` raises it for one that is not damaged.
    """
    faults: dict[str, str] = {}
    found = readable(files, read, faults)
    name_left_out(faults, len(files))
    return list(found.values())


def reason_of(error: DataError) -> str:
    """Returns why an image cannot be read, without its name."""
    return f"cannot be read ({error.__cause__ or error})"


def name_left_out(faults: Mapping[str, str], count: int) -> None:
    """Warns about images that are left out.

    Args:
        faults: what is wrong with each, by name, such as "is black".
        count: number of all images.

    Raises:
        DataError: if no image is left.
    """
    if not faults:
        return
    if count == 1:
        raise DataError(" ".join(("the only image", *next(iter(faults.items())))))
    said = some([f"{name} {fault}" for name, fault in faults.items()], separator="; ")
    if len(faults) == count:
        raise DataError(f"none of the {count} images can be used: {said}")
    log.warning("%d of %d images are left out: %s", len(faults), count, said)
