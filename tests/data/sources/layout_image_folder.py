"""A folder of images."""

from pathlib import Path

from examples.data_sets.image_folder import ImageFolder
from vg2gt.data import Frames

from .layouts import Layout, pixels, save


def write(root: Path, frames: Frames) -> None:
    """PNG files in one folder."""
    for i, image in enumerate(pixels(frames)):
        save(root / "holiday" / f"IMG_{i + 7}.png", image)


LAYOUTS = {"image_folder": Layout(write, ImageFolder, depth_quantum=None)}
