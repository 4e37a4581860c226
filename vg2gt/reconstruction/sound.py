"""Leaves out pictures that cannot be read, and copies."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Sequence
from pathlib import Path

from vg2gt.data.base import DataError
from vg2gt.data.sources.parsing import IMAGE_SUFFIXES
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


def without_copies(pictures: Sequence[Picture]) -> list[Picture]:
    """Pictures without those whose file is equal to an earlier one's, byte for byte; they are named in a warning."""
    first: dict[str, str] = {}
    found, copies = [], []
    for picture in pictures:
        whole = picture.path is not None and picture.path.suffix.lower() in (*IMAGE_SUFFIXES, *HEIC_SUFFIXES)
        key = _digest(picture.path) if whole and picture.path is not None else ""
        if key and key in first:
            copies.append(f"{picture.name} (as {first[key]})")
        else:
            found.append(picture)
            first[key] = picture.name
    if copies:
        log.warning("%d images are copies of others and are left out: %s", len(copies), ", ".join(copies[:10]))
    return found


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def name_damaged(pictures: Sequence[Picture], error: Exception) -> DataError:
    """The error that names all pictures that cannot be read, after one could not.

    Args:
        pictures: all of them.
        error: of the one.
    """
    errors = []
    for picture in pictures:
        try:
            picture.read((64, 64))
        except ValueError as other:
            errors.append(str(other))
    return DataError("; ".join(errors or [str(error)]) + SKIP_DAMAGED)
