"""Folders of photographs without cameras and depth, for reconstruction with estimated cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vg2gt.data.sources.files import FileSource
from vg2gt.data.sources.index import SceneIndex, make_index
from vg2gt.data.sources.parsing import IMAGE_SUFFIXES, pinhole
from vg2gt.io.files import by_number
from vg2gt.io.image_files import Size, image_size, read_color

FOCAL = 1.2
"""Placeholder focal length in units of the larger image side; the usual first guess of structure from motion."""


class ImageFolder(FileSource):
    """Photographs of a scene in a folder, rotated upright according to EXIF.

    Frames are numbered 0, 1, ... in natural order of the file names (``IMG_9`` before ``IMG_10``). Images of several
    sizes are resized to cover the median size and cropped.

    There are no cameras: ``has_cameras`` and ``has_depth`` are False, every pose is the identity, and the intrinsics
    are a guess (focal length 1.2 times the larger side, principal point at the centre). Training rejects such a source.

    Args:
        root: a folder of images, a folder of such folders (one or two levels deep), or a list of these.
        scenes: see ``FileSource``.
        every: use every N-th image only.
        index_cache: see ``FileSource``.
    """

    layout = f"images ({', '.join(suffix[1:] for suffix in IMAGE_SUFFIXES)}), there or up to two folders deeper"
    names_are_paths = True
    is_metric = False
    has_depth = False
    has_cameras = False

    def __init__(
        self,
        root: str | Sequence[str] | None,
        scenes: Sequence[str] | str | None = None,
        every: int = 1,
        index_cache: str | None = None,
    ) -> None:
        super().__init__(root, scenes, None, every, index_cache)

    def is_scene(self, folder: Path) -> bool:
        """Returns whether a folder has images."""
        return bool(_images(folder))

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Lists the images and reads their sizes."""
        color = dict(enumerate(_images(folder)))
        sizes = {i: image_size(path, scene, upright=True) for i, path in color.items()}
        intrinsics = {i: _guess(size) for i, size in sizes.items()}
        return make_index(scene, folder, color, None, dict.fromkeys(color, np.eye(4)), intrinsics, color_size=sizes)

    def read_color(self, index: SceneIndex, row: int) -> NDArray[np.uint8]:
        """Decodes an image and rotates it upright."""
        return read_color(index.color[row], index.name, index.color_size, upright=True)


def _guess(size: Size) -> NDArray[np.float64]:
    focal = FOCAL * max(size)
    return pinhole(focal, focal, (size[1] - 1) / 2, (size[0] - 1) / 2)


def _images(folder: Path) -> list[Path]:
    files = [path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()]
    return sorted((path for path in files if not path.name.startswith(".")), key=lambda path: by_number(path.name))
