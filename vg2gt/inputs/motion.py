"""Whether the camera moved, as structure from motion needs: tripods, bursts, objects that turn before a still room."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from vg2gt.inputs.folds import Matches

MOVED = 0.01  # of the longer side: median shift of matched features if the camera moved at all
STILL = 0.0015  # of the longer side: shift of features that do not move
MOST = 0.5  # share of the matched pairs in which a part of the image is still
PART = 0.3  # share of a pair's matches that do not move, so that they are what structure from motion follows
FEWEST, SPREAD = 15, 8  # still matches of a pair, and cells of the image that they cover: more than a watermark
TURNED = 4  # cells in which nothing is still
CELLS = 10  # along the longer side
START, PARALLAX = 100, "the camera only turned, or moved too little"  # matches from which COLMAP starts a model


def check_motion(matches: Matches, sizes: Mapping[str, tuple[int, int]]) -> None:
    """Checks that the camera moved between the images.

    Args:
        matches: matches of the images.
        sizes: width and height of each image.

    Raises:
        ValueError: if it stood still; the message tells an object that turns before a still background from a tripod.
    """
    shifts = [
        float(np.median(_shift(matches, pair, rows, sizes)))
        for pair, rows in matches.pairs.items()
        if sizes[pair[0]] == sizes[pair[1]]
    ]
    pairs = {
        pair: rows for pair, rows in matches.raw.items() if len(rows) >= FEWEST and sizes[pair[0]] == sizes[pair[1]]
    }
    still = {pair: rows[_shift(matches, pair, rows, sizes) < STILL] for pair, rows in pairs.items()}
    followed = [
        pair
        for pair, rows in still.items()
        if len(rows) >= max(FEWEST, PART * len(pairs[pair])) and _covered(matches, pair, rows, sizes) >= SPREAD
    ]
    if pairs and len(followed) >= MOST * len(pairs):
        if _turning(matches, still, sizes) >= len(matches.features) / 2:
            raise ValueError(
                f"the camera did not move: the background is in place in {len(followed)} of {len(pairs)} pairs of "
                "images, while something turns or moves in front of it, and cameras would follow the background. "
                "Mask it (images in masks/, black where it is), or photograph before a plain background"
            )
        shifts = shifts or [0.0]
        if np.quantile(shifts, 0.9) < MOVED:
            raise ValueError(NOT_MOVED)
    elif len(shifts) >= len(sizes) - 1 and shifts and np.quantile(shifts, 0.9) < MOVED:
        raise ValueError(NOT_MOVED)


NOT_MOVED = (
    "the camera did not move: features stay within 1 % of an image's side of the same place in all images, as on "
    "a tripod or in a burst. Depth shows only from different positions: walk around what you photograph"
)


def why_not_placed(matches: Matches) -> str:
    """Returns what structure from motion lacks to start, for the message of a capture without cameras."""
    count = max((len(rows) for rows in matches.pairs.values()), default=0)
    which = "the two images" if len(matches.features) == 2 else "the two images that match best"
    if count < START:
        return f"{which} have {count or 'no'} features in common, about {START} are needed, so they overlap too little"
    return f"{which} have {count} features in common, enough, but {PARALLAX} between them"


def _shift(
    matches: Matches, pair: tuple[str, str], rows: NDArray[np.int64], sizes: Mapping[str, tuple[int, int]]
) -> NDArray[np.float64]:
    """Returns by how much matched features are shifted, ``[m]``, as a share of the longer side."""
    one, other = (matches.features[name][rows[:, side]] for side, name in enumerate(pair))
    return np.linalg.norm(one - other, axis=1) / max(sizes[pair[0]])


def _cells(pixels: NDArray[np.float64], size: tuple[int, int]) -> NDArray[np.int64]:
    cells = np.clip((pixels / (max(size) / CELLS)).astype(np.int64), 0, CELLS - 1)
    return np.bincount(cells[:, 1] * CELLS + cells[:, 0], minlength=CELLS * CELLS)


def _covered(
    matches: Matches, pair: tuple[str, str], rows: NDArray[np.int64], sizes: Mapping[str, tuple[int, int]]
) -> int:
    """Returns the number of cells of the first image with still features."""
    return int((_cells(matches.features[pair[0]][rows[:, 0]], sizes[pair[0]]) > 0).sum())


def _turning(
    matches: Matches, still: Mapping[tuple[str, str], NDArray[np.int64]], sizes: Mapping[str, tuple[int, int]]
) -> int:
    """Returns the number of images of which a part with many features is still in no other image."""
    rows: dict[str, list[NDArray[np.int64]]] = {name: [] for name in matches.features}
    for pair, part in still.items():
        for side, name in enumerate(pair):
            rows[name].append(part[:, side])
    found = 0
    for name, pixels in matches.features.items():
        fixed = np.unique(np.concatenate([np.zeros(0, np.int64), *rows[name]]))
        everything, remaining = _cells(pixels, sizes[name]), _cells(pixels[fixed], sizes[name])
        found += int(((everything >= 6) & (remaining <= 0.05 * everything)).sum() >= TURNED)
    return found
