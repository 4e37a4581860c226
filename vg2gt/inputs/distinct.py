"""Pictures told apart: unique names, no copies of a file, and no photograph in several versions."""

from __future__ import annotations

import hashlib
import itertools
import logging
import re
from collections import Counter, defaultdict
from collections.abc import Container, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from vg2gt.data.transforms import to_bytes
from vg2gt.inputs.folders import is_photo
from vg2gt.io.errors import some

if TYPE_CHECKING:
    from vg2gt.inputs.pictures import Picture

log = logging.getLogger(__name__)

_VERSIONS = 4  # of a photograph at most; more files of related names are a sequence
_SIDE, _SAME = 64, 0.985  # of reduced images, and least correlation of versions: those reduced to a half have .992 and
# more, views next to each other .981 at most (fox, bananas, monstree, a room)


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


class Versions:
    """Photographs in several versions, by names: IMG_1.HEIC, IMG_1.JPG, IMG_1-edited.jpg, IMG_E1.JPG, small/IMG_1.jpg.

    Views of the same photograph are no views from elsewhere, and one that is left out would be known by the other.
    """

    def __init__(self, pictures: Sequence[Picture]) -> None:
        names = {each.name: _plain(each.path.stem) for each in pictures if each.path is not None}
        stems = set(names.values())
        roots = {name: _root(stem, stems) for name, stem in names.items()}
        counts = Counter(roots.values())
        self._roots = {name: root for name, root in roots.items() if 1 < counts[root] <= _VERSIONS}
        self._seen: dict[str, list[tuple[Picture, NDArray[np.float64]]]] = defaultdict(list)

    def add(self, picture: Picture, pixels: NDArray[np.uint8]) -> None:
        """Takes the pixels ``[h, w, 3]`` of a reduced picture."""
        if picture.name in self._roots:
            small = Image.fromarray(pixels).convert("L").resize((_SIDE, _SIDE), Image.Resampling.BILINEAR)
            self._seen[self._roots[picture.name]].append((picture, np.asarray(small, float).ravel()))

    def faults(self, others: Container[str]) -> dict[str, str]:
        """Returns which pictures show the same as a larger one, or as one of equal size and shorter name.

        Args:
            others: names of pictures that are left out for other reasons.
        """
        found: dict[str, str] = {}
        for group in self._seen.values():
            kept: list[tuple[Picture, NDArray[np.float64]]] = []
            usable = [each for each in group if each[0].name not in others]
            for picture, pixels in sorted(usable, key=lambda each: (-max(each[0].size), len(str(each[0].path)))):
                same = [other for other, seen in kept if _related(picture, other) and _alike(pixels, seen)]
                if same:
                    found[picture.name] = f"shows the same as {same[0].path}"
                else:
                    kept.append((picture, pixels))
        return found


def _plain(stem: str) -> str:
    """Returns a name in lower case, as of the photograph that a phone's edited one comes from."""
    return re.sub(r"^img_e(?=\d)", "img_", stem.lower())


def _root(stem: str, stems: set[str]) -> str:
    """Returns the shortest of the names that continues to this one with a space or a sign."""
    return next((stem[: cut.start()] for cut in re.finditer(r"\W|_", stem) if stem[: cut.start()] in stems), stem)


def _related(one: Picture, other: Picture) -> bool:
    """Returns whether two pictures can be versions: of one folder, or reduced, not of two cameras side by side."""
    folders = [each.path and each.path.parent for each in (one, other)]
    return folders[0] == folders[1] or one.size != other.size


def _alike(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    return min(one.std(), other.std()) > 0 and float(np.corrcoef(one, other)[0, 1]) >= _SAME
