"""What was drawn over photographs and frames of videos: logos, dates, watermarks, subtitles.

It stays where it is in the image while everything else moves, so features on it contradict the cameras' motion. Its
edges have the same direction in all images; those of a scene do not, unless the camera stands still.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

_FEWEST = 8  # images that are compared; of a video, each so many successive ones as well, as subtitles change
_STEEP = 8.0  # values of 255 a pixel from which the direction of an edge counts fully
_SAME, _ALIKE = 0.8, 0.5  # length of the mean direction: of what was drawn, and of what may be scenery as well
_CHANCE = 6.0  # the mean of n random directions is longer than (x / n) ** 0.5 with a probability of exp(-x)
_SHARES = (0.001, 0.05)  # least and largest share of the pixels
_CLEAR = 1.5  # how many times more pixels are the same than are alike elsewhere
_OF_ALL = 0.5  # largest share of all edges: more is a camera that stands still
_NEAR, _GAP = 4, 3  # pixels around such edges, and between them, that belong to them
_CHANGES, _MOST = 4.0, 0.7  # standard deviation over time of 255, and the share of the pixels around that have it
_PART = (10, 0.35)  # least edges of a letter or logo, in pixels, and as a share of all edges there
_SQUARE = np.ones((3, 3), bool)


def find_overlays(images: Sequence[NDArray[np.uint8]], is_video: bool) -> list[NDArray[np.bool_]]:
    """Finds what was drawn over images of one size.

    Args:
        images: each ``[h, w, 3]``, about 320 pixels wide; of a video in order.
        is_video: whether each few successive ones are looked at on their own as well.

    Returns:
        For each image ``[h, w]``, true where something was drawn over it.
    """
    found = [np.zeros(image.shape[:2], bool) for image in images]
    if len(images) < _FEWEST:
        return found
    greys = np.stack([image.mean(2, dtype=np.float32) for image in images])
    edges = _directions(greys)
    windows = [slice(0, len(edges))]
    if is_video:
        windows += [slice(start, start + _FEWEST) for start in range(len(edges) - _FEWEST + 1)]
    for window in windows:
        drawn = _drawn(greys[window], edges[window])
        if drawn is not None:
            for own in found[window]:
                own |= drawn
    return found


def _directions(greys: NDArray[np.floating]) -> NDArray[np.floating]:
    """Returns the gradients ``[n, 2, h, w]`` of images, of length 1 where they are steep."""
    down, right = np.gradient(greys, axis=1), np.gradient(greys, axis=2)
    return np.stack((down, right), 1) / np.maximum(np.hypot(down, right), _STEEP)[:, None]


def _drawn(greys: NDArray[np.floating], edges: NDArray[np.floating]) -> NDArray[np.bool_] | None:
    """Returns ``[h, w]`` what was drawn over images ``[n, h, w]`` with such edges; None if nothing was."""
    down, right = edges.mean(0)
    mean = np.hypot(down, right)
    same = mean > max(_SAME, (_CHANCE / len(edges)) ** 0.5)
    steep = np.hypot(edges[:, 0], edges[:, 1]) > 0.99
    share, all_edges = same.mean(), steep.mean()
    if not _SHARES[0] <= share <= min(_SHARES[1], _OF_ALL * all_edges):
        return None
    around = np.asarray(ndimage.binary_dilation(same, _SQUARE, _NEAR), bool)
    by_chance = all_edges * np.exp(-len(edges) * _ALIKE**2)
    if share < _CLEAR * (((mean > _ALIKE) & ~around).mean() - by_chance):
        return None
    # closing leaves out what is near the image's edge unless there is room around it
    padded = np.pad(np.asarray(ndimage.binary_dilation(same, _SQUARE, _GAP), bool), 2 * _GAP)
    closed = ndimage.binary_fill_holes(ndimage.binary_closing(padded, _SQUARE, _GAP))
    whole = np.asarray(closed, bool)[2 * _GAP : -2 * _GAP, 2 * _GAP : -2 * _GAP]
    labels: NDArray[np.int32] = np.zeros(whole.shape, np.int32)
    ndimage.label(whole, output=labels)
    numbers = np.arange(1, labels.max() + 1)
    drawn_edges, all_of_part = (ndimage.sum_labels(each, labels, numbers) for each in (same, steep.mean(0)))
    parts = numbers[(drawn_edges >= _PART[0]) & (drawn_edges >= _PART[1] * all_of_part)]
    whole = np.isin(labels, parts)
    # the outline of a vase on a turntable before a plain wall is the same as well, but so is the wall
    ring = np.asarray(ndimage.binary_dilation(whole, _SQUARE, _NEAR), bool) & ~whole
    return whole if (same & whole).mean() >= _SHARES[0] and (greys.std(0)[ring] > _CHANGES).mean() >= _MOST else None
