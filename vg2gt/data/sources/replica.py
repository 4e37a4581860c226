"""Replica, as it was rendered for NICE-SLAM."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from vg2gt.data.base import DataError
from vg2gt.data.sources.files import FileSource
from vg2gt.data.sources.index import SceneIndex, make_index
from vg2gt.data.sources.parsing import numbered, pinhole, read_numbers
from vg2gt.data.sources.scene_folders import scene_folders
from vg2gt.geometry.cameras import resize_intrinsics
from vg2gt.io.image_files import Size, image_size, read_depth

DEPTH_SCALE = 6553.5
"""Stored depth units a metre."""

_SIZE = (680, 1200)
_INTRINSICS = pinhole(600.0, 600.0, 599.5, 339.5)
_LARGEST_STRETCH = 0.01


class Replica(FileSource):
    """The eight rooms and offices of Replica with a video in each; a scene is a folder such as ``office0``.

    ``results/frameNNNNNN.jpg`` and ``results/depthNNNNNN.png`` (6553.5 units a metre, 0 = none); line N of ``traj.txt``
    holds the 16 numbers of frame N's camera-to-world matrix (OpenCV, metres). Images are 1200x680 with a focal length
    of 600 and the principal point in the middle, (599.5, 339.5); reduced copies have the same camera in larger pixels.

    Args:
        root: the folder of the scenes, or a scene, or a list of such.
        intrinsics: (fx, fy, cx, cy) in pixels of the images, if another camera rendered them; None: Replica's.
        scenes: names of scenes, or a text file with one a line; None: all.
        holdout: hold out every this many-th frame as an evaluation target; None: none.
        every: use every this many-th frame only (a video has 2000 close ones).
        index_cache: see ``FileSource``.

    Raises:
        FileNotFoundError: if a root does not exist.
        DataError: if a root holds no scene.
    """

    layout = "SCENE/traj.txt and SCENE/results/{frame,depth}*, there or one folder deeper"

    def __init__(
        self,
        root: str | Sequence[str] | None,
        intrinsics: Sequence[float] | None = None,
        scenes: Sequence[str] | str | None = None,
        holdout: int | None = None,
        every: int = 1,
        index_cache: str | None = None,
    ) -> None:
        self.intrinsics = tuple(float(value) for value in intrinsics) if intrinsics else None
        super().__init__(root, scenes, holdout, every, index_cache)

    def find(self, root: Path) -> Mapping[str, Path]:
        """Folders with ``results``, by their name."""
        return scene_folders(root, lambda folder: (folder / "results").is_dir(), levels=1)

    def options(self) -> Mapping[str, object]:
        """The intrinsics that replace Replica's."""
        return {"intrinsics": self.intrinsics}

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Lists a scene's files and reads its poses."""
        color, depth = (numbered(folder / "results", scene, f"{kind}*") for kind in ("frame", "depth"))
        if not color or not depth:
            raise DataError(f"scene {scene} has no {'frame' if not color else 'depth'} images in {folder / 'results'}")
        size = image_size(next(iter(color.values())), scene)
        return make_index(
            name=scene,
            folder=folder,
            color=color,
            depth=depth,
            camera_to_world=_read_trajectory(folder / "traj.txt", scene, max(color)),
            intrinsics=self._intrinsics(folder, scene, size),
            size=size,
            color_size=size,
        )

    def read_depth(self, index: SceneIndex, row: int, size: Size) -> NDArray[np.float32]:
        """Decodes a depth image."""
        return (read_depth(index.depth[row], index.name, size) / DEPTH_SCALE).astype(np.float32)

    def _intrinsics(self, folder: Path, scene: str, size: Size) -> NDArray[np.float64]:
        if self.intrinsics is not None:
            return pinhole(*self.intrinsics)
        scale_x, scale_y = size[1] / _SIZE[1], size[0] / _SIZE[0]
        if abs(scale_x / scale_y - 1) > _LARGEST_STRETCH:
            raise DataError(
                f"the images of scene {scene} in {folder} are {size[1]}x{size[0]}, not 1200x680 or a reduced copy: "
                "another camera rendered them; set data.intrinsics=[fx,fy,cx,cy]"
            )
        return resize_intrinsics(torch.from_numpy(_INTRINSICS), scale_x, scale_y).numpy()


def _read_trajectory(path: Path, scene: str, last: int) -> dict[int, NDArray[np.float64]]:
    """Camera-to-world poses by frame number, which is the number of the line."""
    rows = read_numbers(path, scene)
    if rows.shape[1] != 16 or len(rows) <= last:
        raise DataError(
            f"{path} of scene {scene} must have a line of 16 numbers (4x4 camera-to-world) for each of the frames 0 to "
            f"{last}; it has {rows.shape[0]} lines of {rows.shape[1]}"
        )
    return dict(enumerate(rows[: last + 1].reshape(-1, 4, 4)))
