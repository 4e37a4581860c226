"""ScanNet, exported to image files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vg2gt.data.base import DataError
from vg2gt.data.sources.files import FileSource
from vg2gt.data.sources.index import SceneIndex, files_state, folder_state, make_index
from vg2gt.data.sources.parsing import numbered, read_matrix, read_poses
from vg2gt.data.sources.scene_folders import scene_folders
from vg2gt.io.image_files import Size, image_size, read_depth

DEPTH_SCALE = 1000.0
"""Stored depth units a metre."""
INTRINSICS = "intrinsic/intrinsic_depth.txt"
"""A scan's intrinsics, those of its depth images."""


class ScanNet(FileSource):
    """Scans exported from ScanNet's ``.sens`` files; a scene is a scan such as ``scene0000_00``.

    ``color/N.jpg`` (1296x968), ``depth/N.png`` (640x480, millimetres, 0 = none), ``pose/N.txt`` (4x4 camera-to-world)
    and ``intrinsic/intrinsic_depth.txt`` (4x4). Numbers are not padded. Frames at which tracking was lost have a pose
    of -inf and are left out. Colour is resized to the depth images, which it is registered to, and the intrinsics are
    those of the depth images; extrinsics between the two cameras are the identity and not read.

    Args:
        root: ScanNet's folder, or its ``scans``, or a scan, or a list of such.
        scenes: names of scans, or a text file with one a line (the official ``scannetv2_train.txt``); None: all.
        holdout: hold out every this many-th frame as an evaluation target; None: none.
        every: use every this many-th frame only (the camera takes 30 a second).
        index_cache: see ``FileSource``.

    Raises:
        FileNotFoundError: if a root does not exist.
        DataError: if a root holds no scan.
    """

    layout = "sceneNNNN_NN/{color,depth,pose,intrinsic}, there or up to two folders deeper"

    def find(self, root: Path) -> Mapping[str, Path]:
        """Folders with ``color``, ``depth`` and ``pose``, by their name."""
        return scene_folders(root, lambda folder: all((folder / kind).is_dir() for kind in ("color", "depth", "pose")))

    def place(self, scene: str) -> str:
        """The room: ``scene0000`` of ``scene0000_00`` and ``scene0000_01``."""
        return room_of_scan(scene)

    def state(self, scene: str, folder: Path) -> str:
        """Also that of the intrinsics."""
        return folder_state(folder) + files_state([folder / INTRINSICS])

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Lists a scan's files and reads its poses and intrinsics."""
        color, depth = numbered(folder / "color", scene), numbered(folder / "depth", scene)
        if not color or not depth:
            raise DataError(f"scene {scene} has no {'colour' if not color else 'depth'} images in {folder}")
        poses = numbered(folder / "pose", scene, suffixes=(".txt",))
        depth_size = image_size(next(iter(depth.values())), scene)
        return make_index(
            name=scene,
            folder=folder,
            color=color,
            depth=depth,
            camera_to_world=read_poses(poses, scene),
            intrinsics=read_matrix(folder / INTRINSICS, scene, ((4, 4),))[:3, :3],
            size=depth_size,
            color_size=image_size(next(iter(color.values())), scene),
            depth_size=depth_size,
        )

    def read_depth(self, index: SceneIndex, row: int, size: Size) -> NDArray[np.float32]:
        """Decodes a depth image in millimetres."""
        return (read_depth(index.depth[row], index.name, size) / DEPTH_SCALE).astype(np.float32)


def room_of_scan(scene: str) -> str:
    """What a scan shows: the same room was scanned several times, as ``scene0000_00``, ``scene0000_01``, ..."""
    return scene.split("_")[0]
