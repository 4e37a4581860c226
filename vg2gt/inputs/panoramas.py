"""360 degree panoramas as cube faces: six pinhole images of 90 degrees, with the same centre."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch.nn.functional import grid_sample

from vg2gt.io.image_files import Size, read_color
from vg2gt.io.images import open_image

# Axes of each face in those of the panorama: right, down, forward; its middle looks forward (z), x right, y down.
FACES = {
    "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "right": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "back": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "left": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "up": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "down": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}
_HEAD = 1 << 18  # bytes that hold the metadata
_WIDTH = 512  # pixels of the reduced image whose borders are compared
_LEAST_HEIGHT = 64  # pixels of a panorama
_CONTINUES = 0.5  # correlation of the detail along the left and the right border of a panorama
_LESS = 0.2  # by which columns elsewhere correlate less
_POLE = 0.5  # contrast of the first or last row, all of which is one point, relative to the middle
_LEAST_COVERED = 0.2  # share of a face that a partial panorama shows


@dataclass(frozen=True)
class Panorama:
    """The part of the sphere that an equirectangular image of ``(height, width)`` shows.

    Attributes:
        size: of the image, in pixels.
        whole: ``(height, width)`` of an image of the whole sphere.
        corner: row and column of the image's first pixel in there.
    """

    size: Size
    whole: Size
    corner: tuple[int, int] = (0, 0)

    @property
    def side(self) -> int:
        """Length of a face's side in pixels; its focal length is half of it."""
        return max(self.whole[1] // 4, 1)

    def faces(self) -> dict[str, NDArray[np.float32]]:
        """Returns the position (x, y) in the image of each pixel of the faces that it shows, ``[side, side, 2]``."""
        found = {}
        for name in FACES:
            places = self.places(name)
            inside = (places >= -0.5) & (places <= np.array(self.size[::-1]) - 0.5)
            if inside.all(-1).mean() >= _LEAST_COVERED:
                found[name] = places
        return found

    def places(self, face: str) -> NDArray[np.float32]:
        """Returns the position (x, y) in the image of each pixel of a face, ``[side, side, 2]``."""
        across = (np.arange(self.side) + 0.5) / self.side * 2 - 1
        x, y = np.meshgrid(across, across)
        rays = np.stack([x, y, np.ones_like(x)], -1) @ np.array(FACES[face], float)
        longitude = np.arctan2(rays[..., 0], rays[..., 2])
        latitude = np.arctan2(-rays[..., 1], np.hypot(rays[..., 0], rays[..., 2]))
        column = (longitude / (2 * np.pi) + 0.5) * self.whole[1] - 0.5 - self.corner[1]
        row = (0.5 - latitude / np.pi) * self.whole[0] - 0.5 - self.corner[0]
        return np.stack([column, row], -1).astype(np.float32)

    def cut(self, pixels: NDArray[np.uint8], face: str) -> NDArray[np.uint8]:
        """Returns a face ``[side, side, C]`` of an image ``[H, W, C]`` by bilinear lookup."""
        values = torch.from_numpy(pixels).permute(2, 0, 1)[None].float()
        return (self._sample(values, face) + 0.5).clamp(0, 255).byte()[0].permute(1, 2, 0).contiguous().numpy()

    def cut_mask(self, mask: NDArray[np.float32] | None, face: str) -> NDArray[np.float32] | None:
        """Returns the pixel weights of a face: those of the image, and 0 where it shows nothing; None: all 1."""
        places, (height, width) = self.places(face), self.size
        inside = np.all((places >= -0.5) & (places <= np.array([width, height]) - 0.5), axis=-1)
        inside = np.asarray(inside | (self.size == self.whole))
        if mask is None:
            return None if inside.all() else np.asarray(inside, np.float32)
        found = self._sample(torch.from_numpy(mask)[None, None], face)[0, 0].numpy()
        return np.where(inside, found, 0).astype(np.float32)

    def _sample(self, values: torch.Tensor, face: str) -> torch.Tensor:
        """Looks values ``[1, C, H, W]`` up; the left border continues the right one."""
        wrapped = torch.cat([values[..., -1:], values, values[..., :1]], -1)
        height, width = values.shape[-2:]
        scale = np.array([width, height]) / np.array(self.size[::-1])
        places = torch.from_numpy((self.places(face) + 0.5) * scale.astype(np.float32) - 0.5)
        grid = (places + torch.tensor([1.5, 0.5])) * (2 / torch.tensor([width + 2.0, height])) - 1
        return grid_sample(wrapped, grid[None], "bilinear", padding_mode="border", align_corners=False)


def _described_panorama(path: Path, size: Size) -> Panorama | None:
    """Returns the panorama that an image's XMP metadata (GPano) describe; None if they describe none.

    Args:
        path: the file.
        size: its ``(height, width)``.
    """
    with path.open("rb") as file:
        head = file.read(_HEAD)
    if b"ProjectionType" not in head or b"equirectangular" not in head:
        return None

    def number(name: str) -> int | None:
        found = re.search(rb"GPano:" + name.encode() + rb"\s*(?:=\s*[\"']|>)\s*(\d+)", head)
        return int(found[1]) if found else None

    cropped, whole = number("CroppedAreaImageWidthPixels"), number("FullPanoWidthPixels")
    if not (cropped and whole):
        return Panorama(size, size) if size[1] == 2 * size[0] else None
    scale = size[1] / cropped  # a reduced image keeps the numbers of the original
    full = (round((number("FullPanoHeightPixels") or whole // 2) * scale), round(whole * scale))
    corner = (number("CroppedAreaTopPixels") or 0, number("CroppedAreaLeftPixels") or 0)
    return Panorama(size, full, (round(corner[0] * scale), round(corner[1] * scale)))


def find_panoramas(files: Sequence[tuple[Path, Size]]) -> dict[Path, Panorama]:
    """Returns which of some images, given with their ``(height, width)``, are panoramas.

    Images of twice the width without XMP metadata are taken for panoramas if most of them continue from the right
    border to the left one and have poles.
    """
    found = {path: known for path, size in files if (known := _described_panorama(path, size)) is not None}
    others = [(path, size) for path, size in files if path not in found and may_be_panorama(size)]
    if others and sum(continues(path) for path, _ in others) * 2 > len(others):
        found |= {path: Panorama(size, size) for path, size in others}
    return found


def continues(path: Path) -> bool:
    """Returns whether an image's right border continues at its left one, and its first or last row is one point."""
    try:
        with open_image(path) as image:
            image.draft("L", (_WIDTH, _WIDTH // 2))
            grey = np.asarray(image.convert("L").resize((_WIDTH, _WIDTH // 2), Image.Resampling.BOX), np.float64)
    except Exception:  # whoever reads it says what is wrong
        return False
    return _continues(grey)


def show_spheres(frames: Sequence[NDArray[np.uint8]]) -> bool:
    """Returns whether images ``[H, W, 3]`` of a video are panoramas, by the borders of most of them."""
    small = [Image.fromarray(each).convert("L").resize((_WIDTH, _WIDTH // 2), Image.Resampling.BOX) for each in frames]
    return sum(_continues(np.asarray(each, np.float64)) for each in small) * 2 > len(small)


def may_be_panorama(size: Size) -> bool:
    """Returns whether an image of ``(height, width)`` has the shape of a whole panorama."""
    return size[1] == 2 * size[0] and size[0] >= _LEAST_HEIGHT


def _continues(grey: NDArray[np.float64]) -> bool:
    detail = np.diff(grey, axis=0)
    left, right = detail[:, 0], detail[:, -1]
    if min(left.std(), right.std()) < 0.5:
        return False
    elsewhere = max(_correlation(left, detail[:, part * _WIDTH // 4]) for part in (1, 2, 3))
    together = _correlation(left, right)
    pole = min(grey[0].std(), grey[-1].std()) < _POLE * grey[len(grey) // 2].std()
    return bool(together > _CONTINUES and together > elsewhere + _LESS and pole)


@lru_cache(maxsize=1)
def whole_pixels(path: Path, changed: int) -> NDArray[np.uint8]:
    """Returns the pixels ``[H, W, 3]`` of the panorama that was read last, of whose faces one is read after the other.

    Args:
        path: the file.
        changed: time of its last change.
    """
    return read_color(path, "", upright=True)


def _correlation(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    return float(np.corrcoef(one, other)[0, 1]) if min(one.std(), other.std()) > 0 else 0.0
