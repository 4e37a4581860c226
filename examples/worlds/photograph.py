"""Photographic flaws of images: wrong exposure, sensor noise, JPEG compression."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from vg2gt.data.synthetic.renderer import GAMMA

_STREAM = 4  # separates this random stream from those of the scene
_MOST = 3.0  # maximum exposure error in stops
_NOISE = (0.002, 0.03)  # range of the standard deviation at full brightness (linear)


@dataclass(frozen=True)
class Photograph:
    """Photographic flaws of a scene's images; geometry does not change.

    Args:
        exposure: standard deviation of the exposure error of scenes in stops, clipped to 3 stops; frames of a scene
            vary by an eighth of it. Highlights clip, and sensor noise is added. 0 disables all of this.
        jpeg: range of the JPEG quality of a scene; None for no compression.

    Raises:
        ValueError: if an option is out of range.
    """

    exposure: float = 0.0
    jpeg: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        if self.exposure < 0:
            raise ValueError(f"exposure is a standard deviation in stops, at least 0; got {self.exposure}")
        if self.jpeg is not None and not (len(self.jpeg) == 2 and 1 <= self.jpeg[0] <= self.jpeg[1] <= 100):
            raise ValueError(f"jpeg must be null or a range of qualities within [1, 100]; got {list(self.jpeg)}")

    @property
    def name(self) -> str:
        """Part of file names."""
        jpeg = f"-jpeg{self.jpeg[0]}to{self.jpeg[1]}" if self.jpeg else ""
        return (f"-exposure{self.exposure:g}" if self.exposure else "") + jpeg

    def develop(self, seed: int, image: NDArray[np.uint8], frame: int) -> NDArray[np.uint8]:
        """Applies the flaws to an image.

        Args:
            seed: seed of the scene.
            image: well-exposed image ``[H, W, 3]``.
            frame: frame number.

        Returns:
            The changed image ``[H, W, 3]``.
        """
        scene, own = np.random.default_rng((_STREAM, seed)), np.random.default_rng((_STREAM, seed, frame))
        stops, noise = scene.normal(0, 1), np.exp(scene.uniform(*np.log(_NOISE)))
        quality = scene.random()
        if self.exposure:
            stops = np.clip(self.exposure * (stops + own.normal(0, 0.125)), -_MOST, _MOST)
            light = np.float32(2.0**stops) * (image / np.float32(255)) ** np.float32(1 / GAMMA)
            light += noise * (np.sqrt(light) + 0.1) * own.standard_normal(image.shape, np.float32)
            image = np.rint(255 * np.clip(light, 0, 1) ** np.float32(GAMMA)).astype(np.uint8)
        if self.jpeg:
            low, high = self.jpeg
            buffer = io.BytesIO()
            Image.fromarray(image).save(buffer, "JPEG", quality=low + int(quality * (high - low + 1)))
            image = np.asarray(Image.open(buffer))
        return image
