"""Whether the camera moved, as structure from motion needs: tripods, bursts, objects that turn before a still room."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vg2gt.inputs.pair_evidence import Matches, count_cells
from vg2gt.inputs.pictures import spread

if TYPE_CHECKING:
    from pycolmap import Image, Reconstruction  # pyright: ignore[reportMissingImports]

_MOVED = 0.01  # of the longer side: median shift of matched features if the camera moved at all
_STILL = 0.0015  # of the longer side: shift of features that do not move
_MOST = 0.5  # share of the matched pairs in which a part of the image is still
_PART = 0.3  # share of a pair's matches that do not move, so that they are what structure from motion follows
_FEWEST, _SPREAD = 15, 8  # still matches of a pair, and cells of the image that they cover: more than a watermark
_MANY, _GONE = 6, 0.05  # features of a cell in which nothing is still, and the largest share of still ones there
_TURNED = 4  # such cells of an image with something that turns
_START = 100  # matches from which COLMAP starts a model
_LOOKED_AT, _COMMON, _ROUNDS = 12, 30, 5  # images, points that two of them share, and fits of a rotation
# of the longer side: what rotations leave of shifts; .0026 after a turn on the spot, .02 and more in five photo sets
_PARALLAX = 0.005


def check_motion(matches: Matches) -> None:
    """Checks that the camera moved between the images.

    Raises:
        ValueError: if it stood still; the message tells an object that turns before a still background from a tripod.
    """
    sizes = matches.sizes
    verified, raw = (
        {pair: rows for pair, rows in table.items() if sizes[pair[0]] == sizes[pair[1]]}
        for table in (matches.pairs, matches.raw)
    )
    raw = {pair: rows for pair, rows in raw.items() if len(rows) >= _FEWEST}
    still = {pair: rows[_shift(matches, pair, rows) < _STILL] for pair, rows in raw.items()}
    followed = [pair for pair, rows in still.items() if _is_followed(matches, pair, rows, len(raw[pair]))]
    in_place = bool(raw) and len(followed) >= _MOST * len(raw)
    if in_place and _turning(matches, still) >= len(matches.features) / 2:
        raise ValueError(
            f"the camera did not move: the background is in place in {len(followed)} of {len(raw)} pairs of images, "
            "while something turns or moves in front of it, and cameras would follow the background. Mask it (images "
            "in masks/, black where it is), or photograph before a plain background"
        )
    shifts = [float(np.median(_shift(matches, pair, rows))) for pair, rows in verified.items()]
    known = in_place or len(shifts) >= max(len(sizes) - 1, 1)
    if known and np.quantile(shifts or [0.0], 0.9) < _MOVED:
        raise ValueError(
            "the camera did not move: features stay within 1 % of an image's side of the same place in all images, as "
            "on a tripod or in a burst. Depth shows only from different positions: walk around what you photograph; if "
            "it turned instead, mask the still background"
        )


def check_parallax(model: Reconstruction) -> None:
    """Checks that the camera did not just turn on the spot, of which structure from motion may make a false model.

    After such a turn, a rotation explains where any two images see common points.

    Raises:
        ValueError: if rotations explain most images.
    """
    seen = [_rays(model, image) for image in model.images.values()]
    left = []
    for view in spread(len(seen), min(_LOOKED_AT, len(seen))):
        off = [_off_rotation(*seen[view], *other[:2]) for place, other in enumerate(seen) if place != view]
        left.append(max(off, default=0.0))
    if left and 0 < np.median(left) < _PARALLAX:
        raise ValueError(
            "the camera only turned on the spot: rotations alone explain what the images show. Depth shows only from "
            "different positions: walk around what you photograph"
        )


def _rays(model: Reconstruction, image: Image) -> tuple[NDArray[np.int64], NDArray[np.float64], float]:
    """Returns the points that an image sees ``[n]``, the rays to them ``[n, 3]``, and its focal length in sides."""
    points = [each for each in image.points2D if each.has_point3D()]
    camera = model.cameras[image.camera_id]
    places = np.asarray(camera.cam_from_img(np.array([each.xy for each in points]).reshape(-1, 2)))
    rays = np.concatenate([places, np.ones((len(places), 1))], 1)
    focal = camera.mean_focal_length() / max(camera.width, camera.height)
    return np.array([each.point3D_id for each in points], np.int64), rays / np.linalg.norm(rays, axis=1)[:, None], focal


def _off_rotation(
    points: NDArray[np.int64],
    rays: NDArray[np.float64],
    focal: float,
    other_points: NDArray[np.int64],
    other_rays: NDArray[np.float64],
) -> float:
    """Returns how far common points of two images are from where the best rotation takes them; 0 if they are few."""
    _, first, second = np.intersect1d(points, other_points, return_indices=True)
    if len(first) < _COMMON:
        return 0.0
    one, other = rays[first], other_rays[second]
    error, weight = np.ones(len(one)), np.ones(len(one))
    for _ in range(_ROUNDS):  # weighted so that the sum of distances is least: outliers count little
        left, _, right = np.linalg.svd((other * weight[:, None]).T @ one)
        turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
        error = np.linalg.norm(one @ turn.T - other, axis=1)
        weight = 1 / np.maximum(error, max(np.median(error), 1e-9))
    return float(np.median(error)) * focal


def why_not_placed(matches: Matches) -> str:
    """Returns what structure from motion lacks to start, for the message of a capture without cameras."""
    count = max((len(rows) for rows in matches.pairs.values()), default=0)
    which = "the two images" if len(matches.features) == 2 else "the two images that match best"
    if count < _START:
        return f"{which} have {count or 'no'} features in common, about {_START} are needed, so they overlap too little"
    if len(matches.features) == 2:
        return f"{which} have {count} features in common, but two images do not determine their focal length and motion"
    return f"{which} have {count} features in common, enough, but the camera only turned, or moved too little"


def _shift(matches: Matches, pair: tuple[str, str], rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Returns by how much matched features are shifted, ``[m]``, as a share of the longer side."""
    one, other = (matches.features[name][rows[:, side]] for side, name in enumerate(pair))
    return np.linalg.norm(one - other, axis=1) / max(matches.sizes[pair[0]])


def _is_followed(matches: Matches, pair: tuple[str, str], still: NDArray[np.int64], count: int) -> bool:
    """Returns whether so many of a pair's ``count`` matches are still, all over the image, that cameras follow them."""
    cells = count_cells(matches.features[pair[0]][still[:, 0]], matches.sizes[pair[0]])
    return len(still) >= max(_FEWEST, _PART * count) and int((cells > 0).sum()) >= _SPREAD


def _turning(matches: Matches, still: Mapping[tuple[str, str], NDArray[np.int64]]) -> int:
    """Returns the number of images of which a part with many features is still in no other image."""
    rows: dict[str, list[NDArray[np.int64]]] = {name: [] for name in matches.features}
    for pair, part in still.items():
        for side, name in enumerate(pair):
            rows[name].append(part[:, side])
    found = 0
    for name, pixels in matches.features.items():
        fixed = np.unique(np.concatenate([np.zeros(0, np.int64), *rows[name]]))
        everything, remaining = (count_cells(each, matches.sizes[name]) for each in (pixels, pixels[fixed]))
        found += int(((everything >= _MANY) & (remaining <= _GONE * everything)).sum() >= _TURNED)
    return found
