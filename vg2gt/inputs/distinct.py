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
from scipy import ndimage

from vg2gt.data.transforms import to_bytes
from vg2gt.inputs.folders import is_photo
from vg2gt.io.errors import some

if TYPE_CHECKING:
    from vg2gt.inputs.pictures import Picture

log = logging.getLogger(__name__)

_VERSIONS = 4  # of a photograph in a folder at most; more files of related names are a sequence
_SIDE, _SAME = 64, 0.985  # of reduced images, and least correlation of versions: those reduced to a half have .992 and
# more, views next to each other .981 at most (fox, bananas, monstree, a room)
_BLOCK, _FLAT = 20, 2.0  # pixels of a block, and its least detail (values of 255)
# Correlation of a block's fine detail, and share of such blocks, from which two photographs are copies: 96 % and more
# after changes of colour, 28 % if shifted by 1/400 of the width.
_FITS, _MOST = 0.8, 0.9


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
        paths = {each.name: each.path for each in pictures if each.path is not None}
        stems = {_plain(path.stem) for path in paths.values()}
        roots = {name: _root(_plain(path.stem), stems) for name, path in paths.items()}
        counts = Counter((root, paths[name].parent) for name, root in roots.items())
        sequences = {root for (root, _), count in counts.items() if count > _VERSIONS}
        self._roots = {name: root for name, root in roots.items() if root not in sequences}
        self._seen: dict[str, list[tuple[Picture, NDArray[np.uint8]]]] = defaultdict(list)

    def add(self, picture: Picture, pixels: NDArray[np.uint8]) -> None:
        """Takes the pixels ``[h, w, 3]`` of a reduced picture."""
        if picture.name in self._roots:
            self._seen[self._roots[picture.name]].append((picture, np.asarray(Image.fromarray(pixels).convert("L"))))

    def faults(self, others: Container[str]) -> dict[str, str]:
        """Returns which pictures show the same as a larger one, or as one of equal size and shorter name.

        Args:
            others: names of pictures that are left out for other reasons.
        """
        found: dict[str, str] = {}
        for group in self._seen.values():
            kept: list[tuple[Picture, NDArray[np.uint8]]] = []
            usable = [each for each in group if each[0].name not in others]
            for picture, pixels in sorted(usable, key=lambda each: (-max(each[0].size), len(str(each[0].path)))):
                same = [
                    other
                    for other, seen in kept
                    if _aligned(pixels, seen) or (_related(picture, other) and _alike(pixels, seen))
                ]
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


def _alike(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> bool:
    size = (_SIDE, _SIDE)
    resized = (Image.fromarray(each).resize(size, Image.Resampling.BILINEAR) for each in (one, other))
    small = np.stack([np.asarray(each, float).ravel() for each in resized])
    return small.std(1).min() > 0 and float(np.corrcoef(small)[0, 1]) >= _SAME


def _aligned(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> bool:
    """Returns whether fine detail is at the same places, as in a copy of other colours, but not in a stereo pair."""
    if one.shape != other.shape or min(one.shape) < _BLOCK:
        return False
    rows, columns = (side // _BLOCK for side in one.shape)

    def detail(grey: NDArray[np.uint8]) -> NDArray[np.float64]:
        fine = grey - ndimage.uniform_filter(grey.astype(float), 9)
        blocks = fine[: rows * _BLOCK, : columns * _BLOCK].reshape(rows, _BLOCK, columns, _BLOCK).swapaxes(1, 2)
        blocks = blocks.reshape(rows * columns, -1)
        return blocks - blocks.mean(1, keepdims=True)

    first, second = detail(one), detail(other)
    spreads = np.stack([first.std(1), second.std(1)])
    known = spreads.min(0) > _FLAT
    fit = (first * second).mean(1)[known] / spreads[:, known].prod(0)
    return known.sum() >= max(rows, columns) and bool((fit > _FITS).mean() >= _MOST)
