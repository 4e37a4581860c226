"""DTU's scans in MVSNet's layout of its test set. Files are in millimetres; loaded data is in metres."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Unpack

from vg2gt.data.base import DataError
from vg2gt.data.sources.files import FileSource, HoldoutOptions
from vg2gt.data.sources.index import SceneIndex, check_found, first_size, make_index
from vg2gt.data.sources.parsing import (
    check_intrinsics,
    existing_depth_root,
    numbered,
    read_text_lines,
    rigid,
    to_world,
)
from vg2gt.io.image_files import Size, read_depth
from vg2gt.io.images import open_image

MILLIMETRE = 1e-3
_MASK_THRESHOLD = 10  # pixels have depth only where depth_visual is brighter than this


class DTU(FileSource):
    """Scans with ``images/``, ``cams/%08d_cam.txt`` and ``pair.txt`` (not needed).

    Intrinsics must match the size of the images. The layout has no depth, but depth can come from another folder.

    Args:
        root: a scan, a folder of scans, or a list of these.
        depth_root: folder of ``scanN/depth_map_%04d.pfm`` and ``scanN/depth_visual_%04d.png`` (``Depths_raw`` of
            MVSNet's training set, 1600x1200); null for no depth.
        shared: see ``FileSource``.
    """

    layout = "scans with images/ and cams/NNNNNNNN_cam.txt, there or one folder deeper"
    scene_marks = ("images", "cams")
    levels = 1
    index_options = ("depth_root",)

    def __init__(
        self, root: str | Sequence[str] | None, depth_root: str | None = None, **shared: Unpack[HoldoutOptions]
    ) -> None:
        self.depth_root = existing_depth_root(depth_root)
        self.has_depth = depth_root is not None
        super().__init__(root, **shared)

    def place(self, scene: str) -> str:
        """Returns ``scanN``, so that a scan cannot be used for both training and evaluation."""
        match = re.search(r"scan_?(\d{1,4})", scene)
        return f"scan{int(match[1])}" if match else scene

    def watched(self, scene: str, folder: Path) -> Sequence[Path | None]:
        """Returns the folder of the scan and that of its depth."""
        return folder, self.depth_root and self.depth_root / self.place(scene)

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Lists the images and reads their cameras."""
        color = numbered(folder / "images", scene)
        check_found(scene, folder / "images", {"images": color})
        size = first_size(color, scene)
        files = numbered(folder / "cams", scene, "*_cam.txt", (".txt",))
        cameras = {number: _read_camera(path, scene) for number, path in files.items()}
        for number, (_, matrix) in cameras.items():
            if not (abs(matrix[0, 2] / size[1] - 0.5) < 0.25 and abs(matrix[1, 2] / size[0] - 0.5) < 0.25):
                raise DataError(
                    f"camera {number} in {folder / 'cams'} of scene {scene} has its principal point at "
                    f"({matrix[0, 2]:.6g}, {matrix[1, 2]:.6g}), but the images are {size[1]}x{size[0]}: the camera is "
                    "one of another size"
                )
        depth = None
        if self.depth_root is not None:
            place = self.depth_root / self.place(scene)
            if not place.exists():
                raise DataError(f"scene {scene} has no depth: {place} does not exist; add it, or set no depth_root")
            depth = numbered(place, scene, suffixes=(".pfm",))
        poses, intrinsics = ({number: camera[i] for number, camera in cameras.items()} for i in (0, 1))
        return make_index(scene, folder, color, depth, poses, intrinsics)

    def read_depth(self, index: SceneIndex, row: int, size: Size) -> NDArray[np.float32]:
        """Reads depth in metres, 0 where the mask file is dark."""
        path, scene = index.depth[row], index.name
        try:
            with open_image(path) as image:
                depth = np.array(image)
        except (OSError, ValueError) as error:
            raise DataError(f"cannot read {path} of scene {scene}: {error}; restore it or remove the frame") from error
        if depth.dtype != np.float32 or depth.shape != size:
            raise DataError(
                f"{path} of scene {scene} has {depth.dtype} {depth.shape}; expected a one-channel PFM image of "
                f"{size[1]}x{size[0]} pixels, as its image"
            )
        mask = read_depth(path.with_name(path.stem.replace("depth_map", "depth_visual") + ".png"), scene, size)
        valid = (mask > _MASK_THRESHOLD) & np.isfinite(depth) & (depth > 0)
        return np.where(valid, depth, 0) * np.float32(MILLIMETRE)


def _read_camera(path: Path, scene: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Camera-to-world pose in metres and intrinsics as stored, from an MVSNet camera file.

    It has ``extrinsic`` (4x4 world-to-camera in mm), ``intrinsic`` (3x3) and a depth range.
    """
    words = " ".join(read_text_lines(path, scene)).split()
    try:
        if words[0] != "extrinsic" or words[17] != "intrinsic":
            raise ValueError("'extrinsic' and 16 numbers, 'intrinsic' and 9 numbers are expected")
        pose = np.array([float(word) for word in words[1:17]]).reshape(4, 4)
        intrinsics = np.array([float(word) for word in words[18:27]]).reshape(3, 3)
    except (ValueError, IndexError) as error:
        raise DataError(f"{path} of scene {scene} is not a camera of MVSNet: {error}") from error
    check_intrinsics(intrinsics, f"{path} of scene {scene}")
    pose[:3, 3] *= MILLIMETRE
    if np.isfinite(pose).all():
        pose = rigid(pose[None], [0], f"{path} of scene {scene}")[0]
    return to_world(pose), intrinsics
