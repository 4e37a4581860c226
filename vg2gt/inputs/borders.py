"""Borders of one colour around photographs and frames of videos, which show nothing.

Undistorted photographs have black borders of any shape, the same in all images of a size. Frames and bars, of any
colour, are straight, lie on opposite sides and are as wide in several images. Both end abruptly. A plain background
does neither: its edge differs from image to image.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

_BORDER, _LIT = 6, 24  # values of 255 by which a border differs from its colour at most, and the image next to it least
_BORDERS = (0.001, 0.6)  # least and largest share of the pixels
_MARGIN = 2  # masked pixels along a border, where it is blurred by compression
_EDGE = 2  # further pixels, where the image is lit
_OFTEN = 0.7  # share of the images, and of the pixels along the border, in which they are
_FEWEST = 3  # images that are compared with each other
_SAME = 8  # difference of 255 of the colours of one frame in several images
_STRAIGHT, _DIFFERS = 0.5, 9  # share of the pixels along the edges of a clear frame that differ from it by so much
_CLEAR = 0.2  # share of the images of a size that do
_RINGING = 6  # rows before an edge that compression disturbs, in part
_RUNG = 0.3  # largest share of the pixels of such a row that differ by so much


@dataclass(frozen=True)
class _Plain:
    """An image whose four corners have one colour.

    Attributes:
        name: of the image.
        color: ``[3]`` of the corners.
        off: ``[h, w]`` largest difference of the channels from it.
        widths: ``[4]`` number of rows or columns of that colour at the top, the bottom, the left and the right. What
            compression disturbs along a straight edge counts as well.
    """

    name: str
    color: NDArray[np.int16]
    off: NDArray[np.int16]
    widths: NDArray[np.int64]

    def clear_sides(self, widths: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Returns on which sides ``[4]`` a frame of such widths ends abruptly, along straight lines."""
        top, bottom, left, right = np.where(widths > 0, widths + _MARGIN, 0).tolist()
        height, width = self.off.shape
        inside = self.off[top : height - bottom, left : width - right] > _DIFFERS
        edges = (inside[:1], inside[-1:], inside[:, :1], inside[:, -1:])
        ends = np.array([edge.size > 0 and edge.mean() >= _STRAIGHT for edge in edges])
        return ends & (self.widths == widths) & (widths > 0)


class Borders:
    """The borders of the images of one size."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.peak, self.lit = np.zeros(shape, np.uint8), np.zeros(shape, np.int32)
        self.names: list[str] = []
        self.plain: list[_Plain] = []

    def add(self, name: str, pixels: NDArray[np.uint8]) -> None:
        """Takes an image ``[h, w, 3]``."""
        brightest = pixels.max(2)
        self.peak = np.maximum(self.peak, brightest)
        self.lit += brightest > _LIT
        self.names.append(name)
        if (plain := _plain(name, pixels)) is not None:
            self.plain.append(plain)

    def masks(self) -> dict[str, NDArray[np.float32]]:
        """Returns masks ``[h, w]``, 0 on borders, of the images that have any, by name."""
        if len(self.names) < _FEWEST:
            return {}
        black = self._black()
        return dict.fromkeys(self.names, black) if black is not None else self._frames()

    def _frames(self) -> dict[str, NDArray[np.float32]]:
        masks: dict[str, NDArray[np.float32]] = {}
        rest = [each for each in self.plain if _opposite(each.widths > 0)]
        while rest:
            alike = [each for each in rest if np.abs(each.color - rest[0].color).max() <= _SAME]
            rest = [each for each in rest if np.abs(each.color - rest[0].color).max() > _SAME]
            own = np.stack([each.widths for each in alike])
            widths = np.array([_most_common(side) for side in own.T])
            clear = np.sum([each.clear_sides(widths) for each in alike], 0) >= max(_FEWEST, _CLEAR * len(self.names))
            framed = np.asarray((own[:, clear] >= (widths[clear] - _RINGING).clip(1)).all(1))
            # an object before a plain background may end along straight lines on two sides, but not on three
            if _opposite(clear) and (clear | (widths == 0)).sum() >= 3:
                # where no image shows the edge, as of a white frame along the sky, it is as narrow as in any image
                widths = np.where(clear, widths, own[framed].min(0))
                (top, bottom, left, right), (height, width) = np.where(widths > 0, widths + _MARGIN, 0), self.peak.shape
                mask = np.zeros((height, width), np.float32)
                mask[top : height - bottom, left : width - right] = 1
                masks |= {each.name: mask for each, is_framed in zip(alike, framed, strict=True) if is_framed}
        return masks

    def _black(self) -> NDArray[np.float32] | None:
        """Returns a mask ``[h, w]``, 0 on black borders; None if there are none."""
        labels: NDArray[np.int32] = np.zeros(self.peak.shape, np.int32)
        ndimage.label(self.peak <= _BORDER, output=labels)
        edge = np.concatenate((labels[0], labels[-1], labels[:, 0], labels[:, -1]))
        black = np.isin(labels, np.unique(edge[edge > 0]))
        if not _BORDERS[0] <= black.mean() <= _BORDERS[1]:
            return None
        near: NDArray[np.bool_] = np.asarray(ndimage.binary_dilation(black, np.ones((3, 3)), iterations=_MARGIN), bool)
        around: NDArray[np.bool_] = np.asarray(ndimage.binary_dilation(near, np.ones((3, 3)), iterations=_EDGE), bool)
        ring = around & ~near
        often = self.lit[ring] >= _OFTEN * len(self.names)
        return (~near).astype(np.float32) if len(often) and often.mean() >= _OFTEN else None


def _plain(name: str, pixels: NDArray[np.uint8]) -> _Plain | None:
    corners = pixels[[0, 0, -1, -1], [0, -1, 0, -1]].astype(np.int16)
    color = np.median(corners, 0).astype(np.int16)
    if np.abs(corners - color).max() > _BORDER:
        return None
    off = np.abs(pixels - color).max(2)
    lit = off > _BORDER
    if not lit.any():
        return None
    top, bottom, left, right = (int(side.argmax()) for side in (*_both(lit.any(1)), *_both(lit.any(0))))
    inside = (off > _DIFFERS)[top : off.shape[0] - bottom, left : off.shape[1] - right]
    rung = np.array([_until_edge(shares) for shares in (*_both(inside.mean(1)), *_both(inside.mean(0)))], np.int64)
    return _Plain(name, color, off, np.array([top, bottom, left, right], np.int64) + rung)


def _opposite(sides: NDArray[np.bool_]) -> bool:
    return bool(sides.reshape(2, 2).all(1).any())


def _both(row: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    return row, row[::-1]


def _until_edge(shares: NDArray[np.float64]) -> int:
    """Returns the number of rows that compression disturbs before an edge, by the shares of pixels that differ."""
    edge = int((shares[:_RINGING] >= _STRAIGHT).argmax())
    return edge if edge > 0 and (shares[: edge - 1] <= _RUNG).all() else 0


def _most_common(widths: NDArray[np.int64]) -> int:
    """Returns the most common of some widths; those that differ by one count as well."""
    return int(np.convolve(np.bincount(widths, minlength=3), [0.5, 1, 0.5], "same").argmax())
