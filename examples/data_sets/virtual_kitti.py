"""Virtual KITTI 2: synthetic drives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Unpack

from vg2gt.data.base import DataError
from vg2gt.data.sources.files import FileSource, HoldoutOptions
from vg2gt.data.sources.index import SceneIndex, check_found, make_index
from vg2gt.data.sources.parsing import numbered, pinhole, positive, read_numbers, to_world
from vg2gt.io.image_files import Size

_LARGEST_NUMBER = 1 << 31


class VirtualKITTI2(FileSource):
    """Five drives in ten variations (weather, light, direction), two cameras each, such as ``Scene01/clone/Camera_0``.

    Files are ``SceneNN/VARIATION/frames/{rgb,depth}/Camera_K/{rgb_NNNNN.jpg,depth_NNNNN.png}``. Depth is z-depth in
    centimetres; sky has the largest value, 655.35 m. ``extrinsic.txt`` and ``intrinsic.txt`` have a header line, then
    lines of ``frame camera`` followed by the 16 numbers of a world-to-camera matrix (OpenCV, metres), or by fx, fy, cx,
    cy in pixels. Unpack the archives of colour, depth and text into one folder. Other cars in the scenes move.

    Args:
        root: folder of ``Scene01``, ``Scene02``, ...
        max_depth: points farther than this (metres) have no depth.
        shared: see ``FileSource``; the cameras record ten frames per second.
    """

    layout = "SceneNN/VARIATION/frames/{rgb,depth}/Camera_K and SceneNN/VARIATION/{extrinsic,intrinsic}.txt"
    depth_remedy = "raise data.max_depth, beyond which points have no depth (nor has the sky)"
    depth_scale = 100.0

    def __init__(
        self,
        root: str | Sequence[str] | None,
        max_depth: float = 80.0,
        **shared: Unpack[HoldoutOptions],
    ) -> None:
        self.max_depth = positive("max_depth", max_depth, "metres")
        super().__init__(root, **shared)

    def find(self, root: Path) -> Mapping[str, Path]:
        """Returns scenes for all cameras with colour images; the folder of a scene is that of its variation."""
        cameras = [path for path in sorted(root.glob("Scene*/*/frames/rgb/Camera_[0-9]")) if path.is_dir()]
        variations = [camera.parents[2] for camera in cameras]
        return {
            f"{variation.relative_to(root).as_posix()}/{camera.name}": variation
            for camera, variation in zip(cameras, variations, strict=True)
        }

    def place(self, scene: str) -> str:
        """Returns the drive, as its variations and cameras show the same streets."""
        return scene.split("/")[0]

    def watched(self, scene: str, folder: Path) -> Sequence[Path | None]:
        """Returns the folder of the variation and the folders of the camera's images."""
        return folder, *(folder / "frames" / kind / _camera_folder(scene) for kind in ("rgb", "depth"))

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Lists a camera's files and reads its poses and intrinsics."""
        camera = _camera_folder(scene)
        color, depth = (numbered(folder / "frames" / kind / camera, scene) for kind in ("rgb", "depth"))
        check_found(scene, folder / "frames", {"colour images": color, "depth images": depth})
        number = int(camera.removeprefix("Camera_"))
        extrinsics = _read_rows(folder / "extrinsic.txt", scene, number, 16)
        intrinsics = _read_rows(folder / "intrinsic.txt", scene, number, 4)
        # Frames without intrinsics have no camera.
        poses = {
            frame: to_world(row.reshape(4, 4), f"{folder} (scene {scene})", frame)
            for frame, row in extrinsics.items()
            if frame in intrinsics
        }
        matrices = {frame: pinhole(*row) for frame, row in intrinsics.items()}
        return make_index(scene, folder, color, depth, poses, matrices)

    def read_depth(self, index: SceneIndex, row: int, size: Size) -> NDArray[np.float32]:
        """Decodes a depth image in centimetres to metres; sets depth beyond ``max_depth`` to 0."""
        depth = super().read_depth(index, row, size)
        return np.where(depth <= self.max_depth, depth, np.float32(0))


def _camera_folder(scene: str) -> str:
    return scene.rsplit("/", 1)[1]


def _read_rows(path: Path, scene: str, camera: int, count: int) -> dict[int, NDArray[np.float64]]:
    """Rows of one camera by frame number, without the frame and camera columns."""
    table = read_numbers(path, scene, skip_lines=1)
    if table.shape[1] != count + 2:
        raise DataError(
            f"{path} of scene {scene} must have lines of frame, camera and {count} numbers under a heading, not of "
            f"{table.shape[1]}"
        )
    numbers = table[:, :2]
    if not ((numbers == np.floor(numbers)) & (numbers >= 0) & (numbers < _LARGEST_NUMBER)).all():
        raise DataError(f"{path} of scene {scene} has frames or cameras that are not whole numbers")
    rows = table[table[:, 1] == camera]
    frames, counts = np.unique(rows[:, 0].astype(np.int64), return_counts=True)
    if (counts > 1).any():
        raise DataError(f"{path} of scene {scene} has frame {frames[counts.argmax()]} of camera {camera} twice")
    return {int(row[0]): row[2:] for row in rows}
