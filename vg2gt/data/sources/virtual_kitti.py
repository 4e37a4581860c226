"""Virtual KITTI 2: rendered drives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vg2gt.data.base import DataError
from vg2gt.data.sources.files import FileSource
from vg2gt.data.sources.index import SceneIndex, folder_state, make_index
from vg2gt.data.sources.parsing import inverse, numbered, pinhole, read_numbers, rigid
from vg2gt.io.image_files import Size, image_size, read_depth

DEPTH_SCALE = 100.0
"""Stored depth units a metre."""

_LARGEST_NUMBER = 1 << 31


class VirtualKITTI2(FileSource):
    """Five drives in ten variations (weather, light, direction) and two cameras; a scene is ``Scene01/clone/Camera_0``.

    ``SceneNN/VARIATION/frames/{rgb,depth}/Camera_K/{rgb_NNNNN.jpg,depth_NNNNN.png}``; depth is z-depth in centimetres,
    and the sky holds the largest number, 655.35 m. ``extrinsic.txt`` and ``intrinsic.txt`` begin with a heading; then
    come ``frame camera`` and the 16 numbers of a world-to-camera matrix (OpenCV, metres), or fx, fy, cx, cy in pixels.
    The archives of colour, depth and text unpack into one folder. Other cars move.

    Args:
        root: the folder of ``Scene01``, ``Scene02``, ...
        max_depth: farther points (metres) have no depth.
        scenes: names of scenes, patterns such as ``Scene20/*/Camera_0``, or a text file of them; None: all.
        holdout: hold out every this many-th frame as an evaluation target; None: none.
        every: use every this many-th frame only (the cameras take ten a second).
        index_cache: see ``FileSource``.

    Raises:
        FileNotFoundError: if a root does not exist.
        DataError: if a root holds no scene.
    """

    layout = "SceneNN/VARIATION/frames/{rgb,depth}/Camera_K and SceneNN/VARIATION/{extrinsic,intrinsic}.txt"
    depth_remedy = "raise data.max_depth, beyond which points have no depth (nor has the sky)"

    def __init__(
        self,
        root: str | Sequence[str] | None,
        max_depth: float = 80.0,
        scenes: Sequence[str] | str | None = None,
        holdout: int | None = None,
        every: int = 1,
        index_cache: str | None = None,
    ) -> None:
        if not max_depth > 0:
            raise ValueError(f"max_depth must be positive (metres), got {max_depth}")
        self.max_depth = float(max_depth)
        super().__init__(root, scenes, holdout, every, index_cache)

    def find(self, root: Path) -> Mapping[str, Path]:
        """Cameras with colour images; the folder of a scene is that of the variation."""
        cameras = [path for path in sorted(root.glob("Scene*/*/frames/rgb/Camera_[0-9]")) if path.is_dir()]
        variations = [camera.parents[2] for camera in cameras]
        return {
            f"{variation.relative_to(root).as_posix()}/{camera.name}": variation
            for camera, variation in zip(cameras, variations, strict=True)
        }

    def place(self, scene: str) -> str:
        """The drive: variations and cameras show the same streets."""
        return scene.split("/")[0]

    def state(self, scene: str, folder: Path) -> str:
        """Also that of the camera's images."""
        cameras = [folder / "frames" / kind / _camera_folder(scene) for kind in ("rgb", "depth")]
        return " ".join(folder_state(path) for path in (folder, *cameras) if path.exists())

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Lists a camera's files and reads its poses and intrinsics."""
        camera = _camera_folder(scene)
        color, depth = (numbered(folder / "frames" / kind / camera, scene) for kind in ("rgb", "depth"))
        if not color or not depth:
            raise DataError(f"scene {scene} has no {'colour' if not color else 'depth'} images in {folder / 'frames'}")
        number = int(camera.removeprefix("Camera_"))
        extrinsics = _read_rows(folder / "extrinsic.txt", scene, number, 16)
        intrinsics = _read_rows(folder / "intrinsic.txt", scene, number, 4)
        size = image_size(next(iter(color.values())), scene)
        return make_index(
            name=scene,
            folder=folder,
            color=color,
            depth=depth,
            # A frame that lacks intrinsics is one without a camera.
            camera_to_world={
                frame: _to_world(row.reshape(4, 4), frame, f"{folder} (scene {scene})")
                for frame, row in extrinsics.items()
                if frame in intrinsics
            },
            intrinsics={frame: pinhole(*row) for frame, row in intrinsics.items()},
            size=size,
            color_size=size,
        )

    def read_depth(self, index: SceneIndex, row: int, size: Size) -> NDArray[np.float32]:
        """Decodes a depth image in centimetres; what is farther than ``max_depth`` has none."""
        depth = (read_depth(index.depth[row], index.name, size) / DEPTH_SCALE).astype(np.float32)
        return np.where(depth <= self.max_depth, depth, np.float32(0))


def _camera_folder(scene: str) -> str:
    return scene.rsplit("/", 1)[1]


def _read_rows(path: Path, scene: str, camera: int, count: int) -> dict[int, NDArray[np.float64]]:
    """Rows of one camera by frame number, without the two numbers that say so."""
    table = read_numbers(path, scene, skip_lines=1)
    if table.shape[1] != count + 2:
        raise DataError(
            f"{path} of scene {scene} must have lines of frame, camera and {count} numbers under a heading, not of "
            f"{table.shape[1]}"
        )
    numbers = table[:, :2]
    if not ((numbers == np.floor(numbers)) & (numbers >= 0) & (numbers < _LARGEST_NUMBER)).all():
        raise DataError(f"{path} of scene {scene} has frames or cameras that are no whole numbers")
    rows = table[table[:, 1] == camera]
    frames, counts = np.unique(rows[:, 0].astype(np.int64), return_counts=True)
    if (counts > 1).any():
        raise DataError(f"{path} of scene {scene} has frame {frames[counts.argmax()]} of camera {camera} twice")
    return {int(row[0]): row[2:] for row in rows}


def _to_world(world_to_camera: NDArray[np.float64], frame: int, where: str) -> NDArray[np.float64]:
    """Inverts a pose; one that is not finite stays so, and drops its frame."""
    if not np.isfinite(world_to_camera).all():
        return np.full((4, 4), np.nan)
    return inverse(rigid(world_to_camera[None], [frame], where))[0]
