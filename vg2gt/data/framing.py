"""Framing: resizes, crops or pads frames to the size of a batch and updates their intrinsics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from vg2gt.data.base import Frames
from vg2gt.data.transforms import reduce_to_cover, reduce_to_fit, resize_to_cover, resize_to_fit

_SIZE, _WINDOW = 4, 5  # random streams; the view sampler uses others

Fit = Literal["cover", "pad"]
Crop = Literal["center", "random"]


@dataclass(frozen=True)
class Framing:
    """Framing of the frames of one scene.

    Attributes:
        size: output ``(height, width)``.
        fit: ``cover`` resizes until the size is covered and crops; ``pad`` resizes to fit and pads.
        zoom: additional scale factor before cropping, at least 1.
        place: relative position of the crop window in its range, (down, right) in [0, 1); None: centred.
    """

    size: tuple[int, int]
    fit: Fit = "cover"
    zoom: float = 1.0
    place: tuple[float, float] | None = None

    def apply(self, frames: Frames) -> Frames:
        """Returns frames of ``size`` with updated intrinsics."""
        if self.fit == "pad":
            return resize_to_fit(frames, self.size)
        return resize_to_cover(frames, self.size, self.zoom, self.place)


@dataclass(frozen=True)
class FramingSampler:
    """Samples the framing of training scenes, as a pure function of seed, step and slot.

    The size is drawn once per step, the same on every device. Zoom and crop window are drawn once per scene, so that
    its views keep shared intrinsics and their overlap. ``crop="random"`` shifts the principal point; use it only with
    backbones that take intrinsics as input or predict the principal point. Colours are never changed.

    Args:
        image_size: ``(height, width)``; with ``aspect``, only its area is kept, roughly.
        aspect: range of height / width from which a step's image shape is drawn, log-uniform; None: fixed.
        size_multiple: drawn sizes are multiples of this, the backbone's patch size.
        fit: see ``Framing``; ``pad`` keeps the whole frame and allows neither zoom nor random crops.
        crop: position of the crop window: ``center`` or ``random``.
        zoom: range of the zoom, log-uniform.
        seed: seeds every draw.

    Raises:
        ValueError: if an option or range is invalid.
    """

    image_size: tuple[int, int]
    aspect: Sequence[float] | None = None
    size_multiple: int = 14
    fit: Fit = "cover"
    crop: Crop = "center"
    zoom: Sequence[float] = (1.0, 1.0)
    seed: int = 0

    def __post_init__(self) -> None:
        for name, value, choices in (("fit", self.fit, get_args(Fit)), ("crop", self.crop, get_args(Crop))):
            if value not in choices:
                raise ValueError(f"data.{name} must be one of {', '.join(choices)}, got {value!r}")
        for name, bounds, least in (("aspect", self.aspect, 0.05), ("zoom", self.zoom, 1.0)):
            pair = isinstance(bounds, Sequence) and len(bounds) == 2
            if bounds is not None and not (pair and least <= bounds[0] <= bounds[1] <= 20):
                raise ValueError(f"data.{name} must be a range [least, most] within [{least}, 20], got {bounds}")
        if self.size_multiple < 1:
            raise ValueError(f"data.size_multiple must be at least 1, got {self.size_multiple}")
        if self.fit == "pad" and (self.crop != "center" or tuple(self.zoom) != (1, 1)):
            raise ValueError("data.fit=pad keeps the whole frame: leave data.crop=center and data.zoom=[1,1]")

    @property
    def still(self) -> Framing:
        """The fixed framing used in evaluation."""
        return Framing(self.image_size, self.fit)

    @property
    def moves(self) -> bool:
        """Whether anything is drawn."""
        return self.aspect is not None or self.crop == "random" or tuple(self.zoom) != (1, 1)

    @property
    def largest(self) -> tuple[int, int]:
        """``(height, width)`` that covers every size and zoom that can be drawn."""
        shapes = self.aspect or (self.image_size[0] / self.image_size[1],)
        sizes = [self._size(shape) for shape in shapes]
        zoom = self.zoom[1]
        return math.ceil(max(size[0] for size in sizes) * zoom), math.ceil(max(size[1] for size in sizes) * zoom)

    def reduce(self, frames: Frames) -> Frames:
        """Shrinks frames to the smallest size that is enough for every framing that can be drawn."""
        return (reduce_to_fit if self.fit == "pad" else reduce_to_cover)(frames, self.largest)

    def size(self, step: int) -> tuple[int, int]:
        """Returns ``(height, width)`` of a step's images, the same on all devices."""
        if self.aspect is None:
            return self.image_size
        return self._size(_between(self.aspect, np.random.default_rng((self.seed, _SIZE, step)).random()))

    def draw(self, step: int, slot: int) -> Framing | None:
        """Draws the framing of one scene; None if nothing is drawn.

        Args:
            step: training step.
            slot: index of the scene within the step, over all devices.
        """
        if not self.moves:
            return None
        rng = np.random.default_rng((self.seed, _WINDOW, step, slot))
        zoom, down, right = rng.random(3).tolist()
        place = (down, right) if self.crop == "random" else None
        return Framing(self.size(step), self.fit, _between(self.zoom, zoom), place)

    def _size(self, shape: float) -> tuple[int, int]:
        """Returns the size of about the area of ``image_size`` with the given height / width."""
        if self.aspect is None:
            return self.image_size
        area, unit = self.image_size[0] * self.image_size[1], self.size_multiple
        height = max(1, round(math.sqrt(area * shape) / unit))
        width = max(1, round(math.sqrt(area / shape) / unit))
        return height * unit, width * unit


def _between(bounds: Sequence[float], fraction: float) -> float:
    return float(bounds[0] * (bounds[1] / bounds[0]) ** fraction)
