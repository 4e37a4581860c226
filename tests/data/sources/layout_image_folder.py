"""A folder of images."""

from pathlib import Path

from PIL import Image

from vg2gt.data import Frames
from vg2gt.data.sources import ImageFolder

from .layouts import Layout, pixels


def write(root: Path, frames: Frames) -> None:
    """PNG files in one folder."""
    (root / "holiday").mkdir(parents=True)
    for i, image in enumerate(pixels(frames)):
        Image.fromarray(image).save(root / "holiday" / f"IMG_{i + 7}.png")


LAYOUTS = {"image_folder": Layout(write, lambda root: ImageFolder(str(root)), depth_quantum=None)}
