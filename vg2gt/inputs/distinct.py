"""Pictures told apart: unique names, and no copies of a file."""

from __future__ import annotations

import hashlib
import itertools
import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from vg2gt.data.transforms import to_bytes
from vg2gt.inputs.folders import is_photo
from vg2gt.io.errors import some

if TYPE_CHECKING:
    from vg2gt.inputs.pictures import Picture

log = logging.getLogger(__name__)


def with_unique_names(pictures: Sequence[Picture]) -> list[Picture]:
    """Returns the pictures with a number appended to names that occur more than once, in any case.

    Files named after them must not replace each other on Windows and macOS, which ignore case.
    """
    counts = Counter(picture.name.lower() for picture in pictures)
    numbers = {name: itertools.count() for name, count in counts.items() if count > 1}

    def unused(name: str) -> str:
        candidates = (f"{name}-{number:03d}" for number in numbers[name.lower()])
        return next(candidate for candidate in candidates if candidate.lower() not in counts)

    return [replace(each, name=unused(each.name)) if each.name.lower() in numbers else each for each in pictures]


def without_copies(pictures: Sequence[Picture]) -> list[Picture]:
    """Returns the pictures without byte-identical copies of earlier image files, which are named in a warning."""
    first: dict[str, str] = {}
    found, copies = [], []
    for picture in pictures:
        key = digest(picture) if picture.path is not None and is_photo(picture.path) else None
        if key in first:
            copies.append(f"{picture.name} (as {first[key]})")
            continue
        found.append(picture)
        if key is not None:
            first[key] = picture.name
    if copies:
        log.warning("%d images are copies of others and are left out: %s", len(copies), some(copies))
    return found


def digest(picture: Picture) -> str:
    """Returns the hash of a picture's file, or of its pixels if it has none."""
    if picture.path is not None:
        return hashlib.sha256(picture.path.read_bytes()).hexdigest()
    return hashlib.sha256(to_bytes(picture.read(picture.size).images).numpy().tobytes()).hexdigest()
