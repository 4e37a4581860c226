"""Folders of RGB-D frames with poses: custom recordings and 7-Scenes sequences.

The layout is detected from the files present:

* folders: colour in ``images/``, ``color/``, ``rgb/`` or ``image/``, depth in ``depth/``. Poses are in ``poses.txt``
  (16, 12 or 7 numbers per line, in image order), or in one text file per frame in ``pose/`` or
  ``poses/``. Intrinsics are in ``K.txt`` (3x3) or in ``intrinsic/intrinsic_{color,depth}.txt`` (4x4, as exported from
  ScanNet);
* exports of Record3D, Polycam and Stray Scanner: see ``phone``;
* 7-Scenes: ``frame-NNNNNN.{color.png|jpg,depth.png,pose.txt}`` in one folder, intrinsics in ``camera-intrinsics.txt``.
  Its raw colour and depth are not registered to each other.

Poses are camera-to-world, OpenCV, in metres; in any unit if depth is not read.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from typing_extensions import Unpack

from vg2gt.data.base import DataError
from vg2gt.data.sources.files import FileOptions, FileSource
from vg2gt.data.sources.index import SceneIndex, check_found, first_size, make_index
from vg2gt.data.sources.masks import joined_masks, mask_beside
from vg2gt.data.sources.parsing import (
    IMAGE_SUFFIXES,
    check_intrinsics,
    errors_name,
    four_intrinsics,
    numbered,
    pinhole,
    pose_matrices,
    read_matrix,
    read_numbers,
    read_poses,
)
from vg2gt.data.sources.phone import PACKED, VIDEO, Recording, app_of, read_metres
from vg2gt.geometry.cameras import resize_intrinsics
from vg2gt.io.image_files import Size, check_size, read_color, read_depth, read_mask, read_mask_file
from vg2gt.io.record3d import R3D, is_archive, read_recorded
from vg2gt.io.video import read_frame

_INTRINSICS_FILES = ("K.txt", "camera-intrinsics.txt")
_POSE_FILES = ("poses.txt", "pose.txt")
_POSE_COLUMNS = {16: "4x4 camera-to-world", 12: "3x4", 7: "x y z qx qy qz qw", 8: "time and x y z qx qy qz qw"}
_COLOR_FOLDERS = ("images", "color", "rgb", "image")
_POSE_FOLDERS = ("pose", "poses")
_OFF_CENTRE = 0.15  # maximum offset of the principal point from the centre, as a fraction of width or height


class RGBDFolder(FileSource):
    """Recordings with registered colour and depth images and a pose for every frame.

    A single recording cannot be split by scenes, so every ``holdout``-th frame is held out of training and used as an
    evaluation target. To split a folder of many recordings by scenes instead, set ``scenes``.

    Args:
        root: a recording, a folder of recordings (one or two levels deep), or a list of such folders.
        depth_scale: stored depth units per metre: 1000 for millimetres, 5000 for TUM.
        invalid: stored values that mean "no depth".
        holdout: hold out every ``holdout``-th frame; None: none.
        intrinsics: (fx, fy, cx, cy) in pixels of the colour images; overrides the intrinsics in the folder.
        depth: read depth; False: posed images only, which may also be in the same folder as ``poses.txt`` and
            ``K.txt``.
        shared: see ``FileSource``.
    """

    layout = (
        "images/, color/, rgb/ or image/ with depth/, poses.txt and K.txt, or frame-*.color.png with "
        "frame-*.depth.png, or an export of Record3D (.r3d), Polycam (raw data) or Stray Scanner, there or "
        "up to two folders deeper"
    )
    scene_files = (R3D,)
    recorded = True
    names_are_paths = True
    index_options = ("intrinsics", "has_depth")

    def __init__(
        self,
        root: str | Sequence[str] | None,
        depth_scale: float = 1000.0,
        invalid: Sequence[int] = (0, 65535),
        holdout: int | None = 6,
        intrinsics: Sequence[float] | None = None,
        depth: bool = True,
        **shared: Unpack[FileOptions],
    ) -> None:
        self.has_depth = depth
        self.is_metric = depth
        self.depth_scale = depth_scale
        self.invalid = tuple(int(value) for value in invalid)
        self.intrinsics = four_intrinsics(intrinsics)
        super().__init__(root, holdout=holdout, **shared)

    def is_scene(self, folder: Path) -> bool:
        """Returns whether a folder has colour and depth in one of the layouts; without ``has_depth``, poses suffice."""
        if app_of(folder) is not None:
            return True
        if not self.has_depth:
            return (folder / "poses.txt").is_file() or any((folder / name).is_dir() for name in _POSE_FOLDERS)
        in_folders = (folder / "depth").is_dir() and any((folder / name).is_dir() for name in _COLOR_FOLDERS)
        return in_folders or any(folder.glob("frame-*.color.*"))

    def place(self, scene: str) -> str:
        """Returns the parent folder of 7-Scenes' ``seq-NN``, the room of ScanNet's ``sceneNNNN_NN``, else the scene."""
        folder = self._folders[scene].resolve()
        if re.fullmatch(r"seq-\d+", folder.name):
            return folder.parent.name
        return folder.name.split("_")[0] if re.fullmatch(r"scene\d{4}_\d\d", folder.name) else scene

    def watched(self, scene: str, folder: Path) -> Sequence[Path | None]:
        """Returns the folder, the possible intrinsics files in it and in its parent, and Polycam's ``keyframes``."""
        return folder, *_exported_intrinsics(folder), *_beside(folder.parent), folder / "keyframes"

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Lists the files of a recording and reads its cameras; frames have the size of the depth images."""
        reader = app_of(folder) or self._read_folder
        with errors_name(scene):
            found = reader(folder, scene)
        depth = found.depth if self.has_depth else None
        check_found(scene, folder, {"colour images": found.color, "depth images": [True] if depth is None else depth})
        size = found.color_size if depth is None else found.depth_size or first_size(depth, scene)
        matrices = found.intrinsics
        if self.intrinsics is not None:
            matrices = dict.fromkeys(found.color, pinhole(*self.intrinsics))
        matrices = {frame: _resized(matrix, found.color_size, size) for frame, matrix in matrices.items()}
        return make_index(
            scene, folder, found.color, depth, found.poses, matrices, found.color_size, size=size, depth_size=size
        )

    def read_color(self, index: SceneIndex, row: int, least: Size | None = None) -> NDArray[np.uint8]:
        """Decodes a colour image, or a frame of a video, at full size."""
        path = index.color[row]
        with errors_name(index.name):
            if path.name != VIDEO:
                content = read_recorded(path) if is_archive(path.parent.parent) else None
                return read_color(path, index.name, index.color_size, content)
            pixels = read_frame(path, index.frame_ids[row])
        check_size(path, index.name, pixels.shape[:2], index.color_size)
        return pixels

    def read_mask(self, index: SceneIndex, row: int) -> NDArray[np.float32] | None:
        """Reads the pixel weights from alpha and from ``masks/`` (``mask_beside``); None: all 1."""
        color = index.color[row]
        if color.suffix.lower() not in IMAGE_SUFFIXES or not color.is_file():  # a part of a video or an archive
            return None
        file = mask_beside(color)
        mask = None if file is None else read_mask_file(file, index.name, color)
        return joined_masks([read_mask(color, index.name), mask])

    def read_depth(self, index: SceneIndex, row: int, size: Size) -> NDArray[np.float32]:
        """Decodes depth: floats in metres, or integers in units of ``depth_scale``; 0 where the confidence is 0."""
        path = index.depth[row]
        if path.suffix.lower() == PACKED:
            return read_metres(path, index.name, size)
        depth = super().read_depth(index, row, size)
        confidence = path.parent.parent / "confidence" / path.name
        return depth * (read_depth(confidence, index.name, size) > 0) if confidence.is_file() else depth

    def _read_folder(self, folder: Path, scene: str) -> Recording:
        """Lists a recording in folders or in the layout of 7-Scenes, and reads its cameras."""
        if (folder / "depth").is_dir() or not self.has_depth:
            images = next((folder / name for name in _COLOR_FOLDERS if (folder / name).is_dir()), folder)
            color, depth = numbered(images, scene), numbered(folder / "depth", scene)
            pose_folder = next((folder / name for name in _POSE_FOLDERS if (folder / name).is_dir()), None)
            pose_file = next((folder / name for name in _POSE_FILES if (folder / name).is_file()), None)
            poses = numbered(pose_folder, scene, suffixes=(".txt",)) if pose_folder else pose_file
            cameras = [*_exported_intrinsics(folder), *_beside(folder)]
        else:
            color, depth = (numbered(folder, scene, f"frame-*.{kind}.*") for kind in ("color", "depth"))
            poses = numbered(folder, scene, "frame-*.pose.txt", suffixes=(".txt",))
            cameras = [*_beside(folder), *_beside(folder.parent)]  # in the folder of the frames or of the sequences
        check_found(scene, folder, {"colour images": color, "depth images": depth if self.has_depth else color})
        sound = self.sound(color)
        color_size = first_size(sound, scene)
        depth_size = first_size(depth, scene) if self.has_depth else color_size
        if poses is None:
            raise DataError(
                f"scene {scene} in {folder} has {len(color)} colour and {len(depth)} depth images but no poses: add "
                "poses.txt (a line of 16 numbers, 4x4 camera-to-world, for each image)"
            )
        read = read_poses(poses, scene) if isinstance(poses, dict) else _read_pose_list(poses, scene, list(color))
        intrinsics = np.eye(3)
        if self.intrinsics is None:
            known = [path for path in cameras if path.is_file()]
            intrinsics = _read_intrinsics(known, folder, scene, color_size, depth_size)
        damaged = color.keys() - sound.keys()  # their names have been said
        depth = {i: path for i, path in depth.items() if i not in damaged}
        read = {i: pose for i, pose in read.items() if i not in damaged}
        return Recording(sound, depth, read, dict.fromkeys(sound, intrinsics), color_size, depth_size)


class ScanNet(RGBDFolder):
    """Scans exported from ScanNet's ``.sens`` files; a scene is a scan such as ``scene0000_00``.

    A scan has ``color/N.jpg`` (1296x968), ``depth/N.png`` (640x480, millimetres, 0 = none), ``pose/N.txt`` (4x4
    camera-to-world) and ``intrinsic/intrinsic_depth.txt`` (4x4). Numbers are not padded. Frames with lost tracking have
    a pose of -inf and are left out. Colour is registered to depth: it is resized to the depth images, whose intrinsics
    are used. The extrinsics between the two cameras are the identity and are not read.

    The arguments are those of ``FileSource``. ``root`` is ScanNet's folder, its ``scans``, a single scan, or a list of
    these. ``scenes`` may be the official ``scannetv2_train.txt``. The frame rate is 30 frames per second.
    """

    layout = "sceneNNNN_NN/{color,depth,pose,intrinsic}, there or up to two folders deeper"
    scene_files = ()
    names_are_paths = False

    def __init__(
        self, root: str | Sequence[str] | None, holdout: int | None = None, **shared: Unpack[FileOptions]
    ) -> None:
        super().__init__(root, invalid=(), holdout=holdout, **shared)

    def is_scene(self, folder: Path) -> bool:
        """Returns whether a folder contains all folders of a scan."""
        return all((folder / name).is_dir() for name in ("color", "depth", "pose"))

    def place(self, scene: str) -> str:
        """Returns the room: ``scene0000`` for ``scene0000_00`` and ``scene0000_01``."""
        return scene.split("_")[0]


def _read_pose_list(path: Path, scene: str, frames: Sequence[int]) -> dict[int, NDArray[np.float64]]:
    """Reads camera-to-world poses ``[4, 4]`` by frame number from a file with one line per image, in image order."""
    rows = read_numbers(path, scene)
    if rows.shape[1] not in _POSE_COLUMNS or len(rows) != len(frames):
        known = "; or ".join(f"{count}: {text}" for count, text in _POSE_COLUMNS.items())
        raise DataError(
            f"{path} of scene {scene} must have one line of numbers ({known}) for each of the {len(frames)} images; it "
            f"has {len(rows)} lines of {rows.shape[1]}"
        )
    return dict(zip(frames, pose_matrices(rows), strict=True))


def _read_intrinsics(files: Sequence[Path], folder: Path, scene: str, color: Size, depth: Size) -> NDArray[np.float64]:
    """Returns the intrinsics of the colour images, preferably from ``intrinsic_depth.txt``."""
    if not files:
        raise DataError(
            f"scene {scene} in {folder} has no intrinsics: add K.txt (3x3), or set data.intrinsics=[fx,fy,cx,cy]"
        )
    path = next((path for path in files if path.name == "intrinsic_depth.txt"), files[0])
    size = depth if path.name == "intrinsic_depth.txt" else color
    matrix = read_matrix(path, scene, ((3, 3), (4, 4)))[:3, :3]
    check_intrinsics(matrix, f"{path} of scene {scene}")
    x, y = matrix[0, 2], matrix[1, 2]
    if abs(x / size[1] - 0.5) > _OFF_CENTRE or abs(y / size[0] - 0.5) > _OFF_CENTRE:
        raise DataError(
            f"{path} of scene {scene} has its principal point at ({x:g}, {y:g}), far from the middle of the images of "
            f"{size[1]}x{size[0]}; it seems to be for another resolution (about {2 * x:.0f}x{2 * y:.0f}): scale it to "
            "these images, or set data.intrinsics=[fx,fy,cx,cy], which is used unchanged"
        )
    return _resized(matrix, size, color)


def _resized(matrix: NDArray[np.float64], size: Size, target: Size) -> NDArray[np.float64]:
    """Rescales intrinsics from images of ``size`` to images of ``target``."""
    if size == target:
        return matrix
    return resize_intrinsics(torch.from_numpy(matrix), target[1] / size[1], target[0] / size[0]).numpy()


def _exported_intrinsics(folder: Path) -> list[Path]:
    return [folder / "intrinsic" / f"intrinsic_{kind}.txt" for kind in ("color", "depth")]


def _beside(folder: Path) -> list[Path]:
    return [folder / name for name in _INTRINSICS_FILES]
