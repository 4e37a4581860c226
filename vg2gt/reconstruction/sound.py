"""Leaves out pictures that cannot be read, and copies."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Sequence

from vg2gt.data.base import DataError
from vg2gt.data.sources.parsing import IMAGE_SUFFIXES
from vg2gt.data.transforms import to_bytes
from vg2gt.reconstruction.pictures import HEIC_SUFFIXES, SKIP_DAMAGED, Picture

log = logging.getLogger(__name__)


def readable(pictures: Sequence[Picture]) -> list[Picture]:
    """Those that can be decoded; the others are named in a warning."""
    found = []
    for picture in pictures:
        try:
            picture.read((64, 64))
            found.append(picture)
        except DataError as error:
            log.warning("left out: %s", error)
    return found


def without_copies(pictures: Sequence[Picture], decode: bool = False) -> list[Picture]:
    """Pictures without those whose file is equal to an earlier one's, byte for byte; they are named in a warning.

    Args:
        pictures: in order.
        decode: compare the pixels of pictures that have no file of their own; otherwise these are all kept.
    """
    first: dict[str, str] = {}
    found, copies = [], []
    for picture in pictures:
        whole = picture.path is not None and picture.path.suffix.lower() in (*IMAGE_SUFFIXES, *HEIC_SUFFIXES)
        key = digest(picture) if whole or (decode and picture.path is None) else ""
        if key and key in first:
            copies.append(f"{picture.name} (as {first[key]})")
        else:
            found.append(picture)
            first[key] = picture.name
    if copies:
        log.warning("%d images are copies of others and are left out: %s", len(copies), ", ".join(copies[:10]))
    return found


def digest(picture: Picture) -> str:
    """Hash of a picture's file, or of its pixels where it has none."""
    if picture.path is not None:
        return hashlib.sha256(picture.path.read_bytes()).hexdigest()
    return hashlib.sha256(to_bytes(picture.read(picture.size).images).numpy().tobytes()).hexdigest()


def name_damaged(pictures: Sequence[Picture], error: Exception) -> DataError:
    """The error that names all pictures that cannot be read, after one could not."""
    errors = []
    for picture in pictures:
        try:
            picture.read((64, 64))
        except ValueError as other:
            errors.append(str(other))
    return DataError("; ".join(errors or [str(error)]) + SKIP_DAMAGED)
