"""From images of a lens with known distortion to those of a pinhole camera, by looking every pixel up."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import grid_sample

_LARGEST_ZOOM = 3.0


@dataclass(frozen=True, eq=False)
class Undistortion:
    """A lens, and the pinhole camera that takes its place.

    The distortion maps directions to pixels in closed form, so that looking pixels up needs no iteration and is exact.

    Attributes:
        lens: ``[3, 3]`` intrinsics of the lens, integer pixel centres.
        distortion: OpenCV coefficients: ``k1 k2 k3 k4 p1 p2`` (radial polynomial in the tangent of the angle from the
            axis, tangential), or ``k1 k2 k3 k4`` of the fisheye model (polynomial in the angle).
        fisheye: whether the coefficients are those of the fisheye model.
        size: ``(height, width)`` of the images, before and after.
        intrinsics: ``[3, 3]`` of the undistorted images: the lens's own, with both focal lengths enlarged just so far
            that no pixel falls outside the lens's image.

    Raises:
        ValueError: if no enlargement up to 3 achieves that: the coefficients cannot be those of the images' camera.
    """

    lens: NDArray[np.float64]
    distortion: Mapping[str, float]
    fisheye: bool
    size: tuple[int, int]
    intrinsics: NDArray[np.float64] = field(init=False)

    def __post_init__(self) -> None:
        height, width = self.size
        x, y = np.meshgrid(np.arange(width), np.arange(height), sparse=True)
        # Where the border lies inside and nothing is folded on the way to it, everything lies inside.
        steps = np.linspace(0, 1, 1000)
        lines = [(x, y[:1]), (x, y[-1:]), (x[:, :1], y), (x[:, -1:], y)]
        for corner in ((0, 0), (width - 1, 0), (0, height - 1), (width - 1, height - 1)):
            lines.append(tuple(c + (end - c) * steps for c, end in zip(self.lens[:2, 2], corner, strict=True)))

        def fits(zoom: float) -> bool:
            places = np.concatenate([self._look_up(self._zoomed(zoom), *line).reshape(-1, 2) for line in lines])
            return bool(((places >= -0.5) & (places <= [width - 0.5, height - 0.5])).all())

        low, high = 1.0, 1.0
        while not fits(high):
            low, high = high, high * 1.25
            if high > _LARGEST_ZOOM:
                raise ValueError(f"the distortion {dict(self.distortion)} takes the image's border out of the image")
        while high - low > 1e-4:
            middle = (low + high) / 2
            low, high = (low, middle) if fits(middle) else (middle, high)
        object.__setattr__(self, "intrinsics", self._zoomed(high))

    @cached_property
    def places(self) -> NDArray[np.float64]:
        """``[h, w, 2]`` pixel (x, y) in the lens's image of each undistorted pixel."""
        x, y = np.meshgrid(np.arange(self.size[1]), np.arange(self.size[0]), sparse=True)
        return self._look_up(self.intrinsics, x, y)

    def color(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Undistorts an image ``[h, w, 3]``, bilinearly."""
        sampled = self._sample(torch.from_numpy(pixels).permute(2, 0, 1).float(), "bilinear")  # [3, h, w]
        return (sampled + 0.5).clamp(0, 255).byte().permute(1, 2, 0).contiguous().numpy()

    def depth(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Undistorts z-depth ``[h, w]``: the nearest pixel's, because a mean across an edge is a point in mid-air."""
        return self._sample(torch.from_numpy(depth)[None], "nearest")[0].numpy()

    def _sample(self, image: torch.Tensor, mode: str) -> torch.Tensor:
        grid = (self.places + 0.5) * (2 / np.array(self.size[::-1])) - 1
        grid = torch.from_numpy(grid).float()[None]  # [1, h, w, 2]
        return grid_sample(image[None], grid, mode, padding_mode="border", align_corners=False)[0]

    def _zoomed(self, zoom: float) -> NDArray[np.float64]:
        return self.lens * np.array([[zoom, 1, 1], [1, zoom, 1], [1, 1, 1]])

    def _look_up(self, pinhole: NDArray[np.float64], x: NDArray, y: NDArray) -> NDArray[np.float64]:
        pixels = np.stack(np.broadcast_arrays(x, y), -1)
        directions = (pixels - pinhole[[0, 1], [2, 2]]) / pinhole[[0, 1], [0, 1]]
        with np.errstate(all="ignore"):  # senseless coefficients overflow; the result does not fit
            distorted = _fisheye(directions, self.distortion) if self.fisheye else _radial(directions, self.distortion)
            return distorted * self.lens[[0, 1], [0, 1]] + self.lens[[0, 1], [2, 2]]


def _radial(directions: NDArray[np.float64], k: Mapping[str, float]) -> NDArray[np.float64]:
    """Directions ``[..., 2]`` (x/z, y/z) as a lens with radial and tangential distortion shows them."""
    square = (directions**2).sum(-1, keepdims=True)
    p1, p2 = k.get("p1", 0.0), k.get("p2", 0.0)
    x, y = directions[..., :1], directions[..., 1:]
    tangential_x = 2 * p1 * x * y + p2 * (square + 2 * x**2)
    tangential_y = p1 * (square + 2 * y**2) + 2 * p2 * x * y
    return directions * _series(k, square) + np.concatenate((tangential_x, tangential_y), -1)


def _fisheye(directions: NDArray[np.float64], k: Mapping[str, float]) -> NDArray[np.float64]:
    """Directions ``[..., 2]`` (x/z, y/z) as an equidistant fisheye lens shows them."""
    radius = np.sqrt((directions**2).sum(-1, keepdims=True))
    angle = np.arctan(radius)
    return directions * _series(k, angle**2) * np.where(radius > 1e-9, angle / np.maximum(radius, 1e-9), 1)


def _series(k: Mapping[str, float], square: NDArray[np.float64]) -> NDArray[np.float64]:
    """1 + k1 s + k2 s^2 + k3 s^3 + k4 s^4; NaN beyond where the lens would fold the image over itself."""
    coefficients = [k.get(f"k{i}", 0.0) for i in (1, 2, 3, 4)]
    slope = 1 + sum((2 * i + 3) * value * square ** (i + 1) for i, value in enumerate(coefficients))
    series = 1 + sum(value * square ** (i + 1) for i, value in enumerate(coefficients))
    return np.where(slope > 0, series, np.nan)
