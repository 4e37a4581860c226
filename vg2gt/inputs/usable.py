"""Leaves out pictures that show nothing (damaged, black, blurred, hidden) or nothing new; masks borders and texts."""

from __future__ import annotations

import logging
import math
from collections.abc import Container, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from vg2gt.data.base import DataError, Frames
from vg2gt.data.sources.masks import joined_masks, resized_mask
from vg2gt.data.transforms import to_bytes
from vg2gt.inputs.borders import Borders
from vg2gt.inputs.damaged import name_left_out, reason_of
from vg2gt.inputs.distinct import Versions, without_copies
from vg2gt.inputs.overlays import find_overlays
from vg2gt.inputs.pictures import IN_MEMORY, Picture
from vg2gt.io.errors import some
from vg2gt.io.images import curvatures
from vg2gt.monitor import Monitor

log = logging.getLogger(__name__)

_SIDE = 320  # longer side of the images that are looked at
_BLACK, _WHITE = 12, 250  # values of 255 up to and from which a pixel shows nothing
_NOISE = 4  # pixels over which noise is averaged
_ALL, _NEARLY_ALL, _USUAL = 0.995, 0.9, 0.5  # shares of such pixels: always, or where most images have fewer than usual
_FLAT = 1.0  # standard deviation of the brightness of an image that shows nothing
_GREY, _COLORFUL = 3, 20  # difference of the channels in 99 of 100 pixels: of a grey image, of a coloured one
_COARSE = (4, 16)  # pixels of structures that blur leaves
_BLURRED = 0.03  # least detail of 1 pixel in the worst direction, relative to the coarse one and to the images' median
_SHOWN = 0.001  # share of the pixels that a mask shows at least
_WIDE, _HALF, _PAIR = 1.7, 32, 0.9  # shape of stereo pairs, pixels of a half, least correlation of the halves
_REPEATED = 0.3  # mean difference of 255 of a video's frame from the one before, up to which it is the same
_FEWEST = 3  # images that are compared with each other


@dataclass(frozen=True)
class _Look:
    """What a small copy of a picture shows.

    Attributes:
        black: share of black pixels.
        white: share of white pixels.
        spread: standard deviation of the brightness.
        detail: fine detail relative to the coarse one.
        color: difference of the channels, of 255.
        is_pair: whether it is a stereo pair, side by side.
    """

    black: float
    white: float
    spread: float
    detail: float
    color: float
    is_pair: bool


@dataclass(frozen=True)
class _SameSize:
    """Pictures of one size.

    Attributes:
        borders: their borders.
        samples: small copies ``[h, w, 3]`` by name, of about 100 photographs at most and of all frames of videos.
    """

    borders: Borders
    samples: dict[str, NDArray[np.uint8]]


def usable_pictures(pictures: Sequence[Picture], monitor: Monitor) -> list[Picture]:
    """Returns the pictures that can be read and show something; of identical files, only the first.

    Those left out are named in a warning. Borders (:mod:`vg2gt.inputs.borders`) and what was drawn over images
    (:mod:`vg2gt.inputs.overlays`) are masked.

    Args:
        pictures: the pictures; each is decoded once, at a small size. Long videos are not looked at.
        monitor: shows the progress.

    Raises:
        ValueError: if none is left.
    """
    pictures = without_copies(pictures)
    if sum(picture.container is not None for picture in pictures) > IN_MEMORY:
        return pictures
    looks: dict[str, _Look] = {}
    faults: dict[str, str] = {}
    by_size: dict[tuple[int, int], _SameSize] = {}
    versions, before = Versions(pictures), np.zeros((0, 0, 3), np.uint8)
    with monitor.stage("check images", len(pictures)) as advance:
        for number, picture in enumerate(pictures):
            try:
                pixels, shown = _small(picture)
            except DataError as error:
                faults[picture.name] = reason_of(error)
            else:
                if shown < _SHOWN:
                    faults[picture.name] = "is hidden by its mask (white in masks is what counts)"
                if picture.container is not None and _repeats(pixels, before):
                    faults[picture.name] = "repeats the frame before"
                before = pixels
                versions.add(picture, pixels)
                looks[picture.name] = _look(pixels)
                if _may_have_borders(picture):
                    group = by_size.setdefault(picture.size, _SameSize(Borders(pixels.shape[:2]), {}))
                    group.borders.add(picture.name, pixels)
                    if picture.container is not None or number % math.ceil(len(pictures) / IN_MEMORY) == 0:
                        group.samples[picture.name] = pixels
            advance()
    faults |= _faults(looks)
    faults |= versions.faults(faults)
    pairs = [name for name, look in looks.items() if look.is_pair]
    if 2 * len(pairs) > len(looks):
        log.warning(
            "%d images show the same twice, side by side, as stereo cameras and spatial photographs do: cut them into "
            "their halves, or the scene will be wrong: %s", len(pairs), some(pairs),
        )  # fmt: skip
    name_left_out(faults, len(pictures))
    is_video = any(picture.container is not None for picture in pictures)
    masks = _masks_of([*by_size.values()], faults, is_video)
    found = [each for each in pictures if each.name not in faults]
    return [_masked(each, masks[each.name]) if each.name in masks else each for each in found]


def _may_have_borders(picture: Picture) -> bool:
    """Returns whether borders of a picture are to be looked for: not where we undistort it, nor with depth."""
    return not picture.lens and not picture.has_depth


def _masks_of(groups: Sequence[_SameSize], left_out: Container[str], is_video: bool) -> dict[str, NDArray[np.float32]]:
    """Returns masks ``[h, w]``, 0 on borders and on what was drawn over images, of those that have any, by name.

    Args:
        groups: the pictures of each size.
        left_out: names of those that are not used.
        is_video: whether they are frames of videos, in order.
    """
    borders: dict[str, NDArray[np.float32]] = {}
    overlays: dict[str, NDArray[np.float32]] = {}
    for group in groups:
        borders |= {name: mask for name, mask in group.borders.masks().items() if name not in left_out}
        looked_at = {name: pixels for name, pixels in group.samples.items() if name not in left_out}
        drawn = dict(zip(looked_at, find_overlays([*looked_at.values()], is_video), strict=True))
        everywhere = np.logical_and.reduce([*drawn.values()]) if drawn else np.zeros(0, bool)  # in those not sampled
        shown = {name: drawn.get(name, everywhere) for name in group.borders.names if name not in left_out}
        overlays |= {name: 1 - own.astype(np.float32) for name, own in shown.items() if own.any()}
    for masks, what in ((borders, "have borders of one colour"), (overlays, "have a logo, a date or a text over them")):
        if masks:
            share = 100 * np.mean([1 - mask.mean() for mask in masks.values()])
            log.warning("%d images %s, %.1f %% of their pixels, which are masked", len(masks), what, share)
    return {name: borders.get(name, 1) * overlays.get(name, np.float32(1)) for name in borders | overlays}


def _small(picture: Picture) -> tuple[NDArray[np.uint8], float]:
    """Reads a picture ``[h, w, 3]`` with a longer side of at most 320 pixels, its depth too if it has any.

    Returns:
        The pixels, and the share of them that its mask shows.
    """
    scale = min(1.0, _SIDE / max(picture.size))
    height, width = (max(1, round(side * scale)) for side in picture.size)
    frames = picture.read((height, width))
    pixels = to_bytes(frames.images[0]).permute(1, 2, 0).numpy()
    shown = 1.0 if frames.mask is None else float(frames.mask.mean())
    return np.asarray(Image.fromarray(pixels).resize((width, height), Image.Resampling.BOX)), shown


def _repeats(pixels: NDArray[np.uint8], before: NDArray[np.uint8]) -> bool:
    """Returns whether a picture is the one before, as in videos that were converted to more frames per second."""
    return pixels.shape == before.shape and float(np.abs(pixels - before.astype(float)).mean()) <= _REPEATED


def _look(pixels: NDArray[np.uint8]) -> _Look:
    grey = pixels.mean(2, dtype=np.float32)
    smooth = np.asarray(Image.fromarray(pixels).reduce(_NOISE)) if min(grey.shape) >= 16 * _NOISE else pixels
    fine, *coarse = (curvatures(grey, step) for step in (1, *_COARSE))
    detail = float((fine / np.maximum(np.max(coarse, 0), 1e-6)).min())
    black, white = (smooth.max(2) <= _BLACK).mean(), (smooth.min(2) >= _WHITE).mean()
    color = float(np.quantile(np.ptp(smooth, axis=2), 0.99))
    return _Look(float(black), float(white), float(smooth.mean(2).std()), detail, color, _is_stereo_pair(pixels))


def _is_stereo_pair(pixels: NDArray[np.uint8]) -> bool:
    """Returns whether the left and the right half of a wide picture show the same, shifted a little."""
    height, width = pixels.shape[:2]
    if width < _WIDE * height:
        return False
    small = np.asarray(Image.fromarray(pixels).convert("L").resize((2 * _HALF, _HALF), Image.Resampling.BOX), float)
    left, right = small[:, :_HALF], small[:, _HALF:]
    if min(left.std(), right.std()) < _FLAT:
        return False
    halves, reach = ((left, right), (right, left)), range(_HALF // 8)  # also of crossed eyes
    shifts = ((one[:, shift:], other[:, : _HALF - shift]) for one, other in halves for shift in reach)
    return max(float(np.corrcoef(one.ravel(), other.ravel())[0, 1]) for one, other in shifts) > _PAIR


def _faults(looks: dict[str, _Look]) -> dict[str, str]:
    """Returns what is wrong with pictures that show nothing, some of it by comparison with the others."""
    if not looks:
        return {}
    several = len(looks) >= _FEWEST
    black, white, detail, color = (
        float(np.median([getattr(look, name) for look in looks.values()]))
        for name in ("black", "white", "detail", "color")
    )
    bilevel = np.quantile([look.black + look.white for look in looks.values()], 0.5, method="lower")

    def fault(look: _Look) -> str:
        """Returns what is wrong with one; empty if nothing is."""
        both = look.black + look.white if min(look.black, look.white) > _SHOWN else 0
        if several and both >= _NEARLY_ALL and bilevel < _USUAL:
            return "is black and white only (a mask? masks are in a folder masks/, with the names of their images)"
        if look.black >= (_NEARLY_ALL if several and black < _USUAL else _ALL):
            return "is black"
        if look.white >= (_NEARLY_ALL if several and white < _USUAL else _ALL):
            return "is over-exposed"
        if look.spread < _FLAT:
            return "is of one colour"
        if several and look.color <= _GREY and color >= _COLORFUL:
            return "is without colour (of a thermal or infrared camera?)"
        return "is blurred" if several and look.detail < _BLURRED * detail else ""

    return {name: found for name, look in looks.items() if (found := fault(look))}


def _masked(picture: Picture, mask: NDArray[np.float32]) -> Picture:
    def read(size: tuple[int, int]) -> Frames:
        frames = picture.read(size)
        shape = (frames.images.shape[-2], frames.images.shape[-1])
        own = (resized_mask(mask, shape) > 0.99).astype(np.float32)  # no pixel that is partly on the border
        known = None if frames.mask is None else frames.mask[0].numpy()
        joined = joined_masks([own, known])
        return replace(frames, mask=None if joined is None else torch.from_numpy(joined)[None])

    return replace(picture, read=read)
