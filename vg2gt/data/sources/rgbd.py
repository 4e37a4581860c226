"""Folders of RGB-D frames with poses: people's own recordings, 7-Scenes sequences.

Layouts, told apart by what is there:

* folders: colour in ``images/``, ``color/``, ``rgb/`` or ``image/``, depth in ``depth/``, poses in ``poses.txt`` (16
  numbers per line, in the order of the images; others: ``rgbd_cameras``) or one text file per frame in ``pose/`` or
  ``poses/``, intrinsics in ``K.txt`` (3x3) or in ``intrinsic/intrinsic_{color,depth}.txt`` (4x4, as ScanNet is
  exported); so also recordings of Open3D and Redwood (``trajectory.log``, ``camera_intrinsic.json``) and ICL-NUIM;
* exports of Record3D, Polycam and Stray Scanner: see ``phone``;
* 7-Scenes: ``frame-NNNNNN.{color.png|jpg,depth.png,pose.txt}`` in one folder, intrinsics in ``camera-intrinsics.txt``.

Poses are camera-to-world, OpenCV, metres. Without depth the unit may be any.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from typing_extensions import Unpack

from vg2gt.data.base import DataError
from vg2gt.data.sources.files import FileOptions, FileSource
from vg2gt.data.sources.index import SceneIndex, check_found, first_size, make_index
from vg2gt.data.sources.parsing import (
    check_intrinsics,
    errors_name,
    four_intrinsics,
    numbered,
    pinhole,
    positive,
    read_poses,
)
from vg2gt.data.sources.phone import (
    EXR,
    PACKED,
    VIDEO,
    PhoneExport,
    app_of,
    confidence_of,
    read_color_file,
    read_export,
    read_packed_depth,
)
from vg2gt.data.sources.rgbd_cameras import (
    INTRINSICS_FILES,
    POSE_FILES,
    mirrored,
    pose_file_of,
    read_camera,
    read_pose_list,
)
from vg2gt.data.sources.scannet import room_of_scan
from vg2gt.geometry.cameras import resize_intrinsics
from vg2gt.io.exr import read_exr
from vg2gt.io.image_files import Size, check_size, read_depth
from vg2gt.io.record3d import R3D
from vg2gt.io.video import read_frame

log = logging.getLogger(__name__)

_COLOR_FOLDERS = ("images", "color", "rgb", "image")
_POSE_FOLDERS = ("pose", "poses")
_OFF_CENTRE = 0.15  # most of an image's width or height that a principal point may lie from its middle


@dataclass(frozen=True)
class _Files:
    """What a recording consists of."""

    layout: str
    color: dict[int, Path]
    depth: dict[int, Path]
    poses: dict[int, Path] | Path | None
    intrinsics: tuple[Path, ...]


class RGBDFolder(FileSource):
    """Recordings with registered colour and depth images and a pose for every frame.

    One recording cannot be split by scenes, so every ``holdout``-th frame is held out: training never sees it and
    evaluation scores it. Give ``scenes`` to split a folder of many recordings by scenes instead.

    Args:
        root: a recording, a folder of recordings (one or two levels deep), or a list of such folders.
        depth_scale: stored depth units per metre: 1000 for millimetres, 5000 for TUM.
        invalid: stored values that mean "no depth".
        holdout: hold out every this many-th frame; None: none.
        intrinsics: (fx, fy, cx, cy) in pixels of the colour images, where the folder has no intrinsics or wrong ones.
        depth: read depth; False: posed images alone, which may also be next to ``poses.txt`` and ``K.txt``.
        shared: see ``FileSource``.
    """

    layout = (
        "images/, color/, rgb/ or image/ with depth/, poses.txt and K.txt, or frame-*.color.png with "
        "frame-*.depth.png, or an export of Record3D (.r3d, EXR + JPG), Polycam (raw data) or Stray Scanner, there or "
        "up to two folders deeper"
    )
    scene_files = (R3D,)
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
        self.depth_scale = positive("depth_scale", depth_scale, "stored units per metre")
        self.invalid = tuple(int(value) for value in invalid)
        self.intrinsics = four_intrinsics(intrinsics)
        super().__init__(root, holdout=holdout, **shared)

    def is_scene(self, folder: Path) -> bool:
        """Whether it has colour and depth in one of the layouts, or, where depth is not asked for, poses."""
        if app_of(folder) is not None:
            return True
        if not self.has_depth:
            return (folder / "poses.txt").is_file() or any((folder / name).is_dir() for name in _POSE_FOLDERS)
        in_folders = (folder / "depth").is_dir() and any((folder / name).is_dir() for name in _COLOR_FOLDERS)
        return in_folders or any(folder.glob("frame-*.color.*"))

    def place(self, scene: str) -> str:
        """What several recordings show: the folder of 7-Scenes' ``seq-NN``, the room of ScanNet's ``sceneNNNN_NN``."""
        folder = self._folders[scene].resolve()
        if re.fullmatch(r"seq-\d+", folder.name):
            return folder.parent.name
        return room_of_scan(folder.name) if re.fullmatch(r"scene\d{4}_\d\d", folder.name) else scene

    def watched(self, scene: str, folder: Path) -> Sequence[Path | None]:
        """Also the intrinsics, which are in a folder of it or next to it."""
        return folder, *_exported_intrinsics(folder), *_beside(folder.parent), folder / "keyframes"

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Lists a recording's files and reads its poses and intrinsics."""
        export = read_export(folder, scene)
        if export is not None:
            return self._index_of_export(export, folder, scene)
        in_folders = (folder / "depth").is_dir() or not self.has_depth
        files = _files_in_folders(folder, scene) if in_folders else _files_of_seven_scenes(folder, scene)
        check_found(scene, folder, {"colour images": files.color})
        depth = files.depth if self.has_depth else None
        if depth is not None:
            check_found(scene, folder, {"depth images": depth})
        color_size = first_size(files.color, scene)
        depth_size = color_size if depth is None else first_size(depth, scene)
        poses = _read_poses(files, folder, scene)
        intrinsics, upwards = self._depth_intrinsics(files.intrinsics, folder, scene, color_size, depth_size)
        poses = mirrored(poses) if upwards else poses
        index = make_index(
            scene,
            folder,
            files.color,
            depth,
            poses,
            intrinsics,
            color_size,
            size=depth_size,
            depth_size=depth_size,
        )
        size = f"{depth_size[1]}x{depth_size[0]}"
        _say(f"scene {scene}: {files.layout}, {len(index.frame_ids)} frames of {size} in {folder}")
        if color_size[0] > depth_size[0]:
            larger = f"{color_size[1]}x{color_size[0]}"
            _say(f"scene {scene}: colour of {larger} is reduced to the depth's {size}", logging.WARNING)
        return index

    def read_color(self, index: SceneIndex, row: int) -> NDArray[np.uint8]:
        """Decodes a colour image, or a frame of a video."""
        path = index.color[row]
        if path.name != VIDEO:
            return read_color_file(path, index.name, index.color_size)
        with errors_name(index.name):
            pixels = read_frame(path, index.frame_ids[row])
        check_size(path, index.name, pixels.shape[:2], index.color_size)
        return pixels

    def read_depth(self, index: SceneIndex, row: int, size: Size) -> NDArray[np.float32]:
        """Decodes depth; of floats in metres, of whole numbers in ``depth_scale``, without what has no confidence."""
        path = index.depth[row]
        if path.suffix.lower() in (EXR, PACKED):
            with errors_name(index.name):
                depth = read_exr(path) if path.suffix.lower() == EXR else read_packed_depth(path, size)
            check_size(path, index.name, depth.shape, size)
            return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)
        depth = super().read_depth(index, row, size)
        confidence = confidence_of(path)
        return depth if confidence is None else depth * (read_depth(confidence, index.name, size) > 0)

    def _index_of_export(self, export: PhoneExport, folder: Path, scene: str) -> SceneIndex:
        """The index of what an app has exported; frames have the depth's size."""
        check_found(scene, folder, {"colour images": export.color})
        depth = export.depth if self.has_depth else None
        if depth is not None:
            check_found(scene, folder, {"depth images": depth})
        size = export.color_size if depth is None else export.depth_size(scene)
        scale = (size[1] / export.color_size[1], size[0] / export.color_size[0])
        intrinsics = export.intrinsics
        if self.intrinsics is not None:
            intrinsics = dict.fromkeys(export.color, pinhole(*self.intrinsics))
        resized = {i: resize_intrinsics(torch.from_numpy(m), *scale).numpy() for i, m in intrinsics.items()}
        _say(f"scene {scene}: export of {export.app} in {folder}, {len(export.color)} frames of {size[1]}x{size[0]}")
        return make_index(
            scene, folder, export.color, depth, export.poses, resized, export.color_size, size=size, depth_size=size
        )

    def _depth_intrinsics(
        self, files: Sequence[Path], folder: Path, scene: str, color: Size, depth: Size
    ) -> tuple[NDArray[np.float64], bool]:
        """Intrinsics of the depth images, and whether y points up: their own file, or the colour images' resized."""
        own = [path for path in files if path.name == "intrinsic_depth.txt"]
        upwards = False
        if self.intrinsics is not None:
            matrix = pinhole(*self.intrinsics)
        elif files:
            path = (own or files)[0]
            matrix, upwards = read_camera(path, scene)
            _check_resolution(matrix, f"{path} of scene {scene}", depth if own else color)
        else:
            raise DataError(
                f"scene {scene} in {folder} has no intrinsics: add K.txt (3x3), or set data.intrinsics=[fx,fy,cx,cy]"
            )
        if own and self.intrinsics is None:
            return matrix, upwards
        return resize_intrinsics(torch.from_numpy(matrix), depth[1] / color[1], depth[0] / color[0]).numpy(), upwards


def _check_resolution(matrix: NDArray[np.float64], where: str, size: Size) -> None:
    """Refuses intrinsics of other images: those of another resolution have their principal point off the middle."""
    check_intrinsics(matrix, where)
    x, y = matrix[0, 2], matrix[1, 2]
    if abs(x / size[1] - 0.5) > _OFF_CENTRE or abs(y / size[0] - 0.5) > _OFF_CENTRE:
        raise DataError(
            f"{where} has its principal point at ({x:g}, {y:g}), far from the middle of the images of "
            f"{size[1]}x{size[0]}: is it of another resolution (about {2 * x:.0f}x{2 * y:.0f})? Scale it to these "
            "images, or set data.intrinsics=[fx,fy,cx,cy], which is taken as it is"
        )


@lru_cache
def _say(message: str, level: int = logging.INFO) -> None:
    """Logs a message once, although training and evaluation both read the recording."""
    log.log(level, message)


def _files_in_folders(folder: Path, scene: str) -> _Files:
    color = next((folder / name for name in _COLOR_FOLDERS if (folder / name).is_dir()), folder)
    pose_folder = next((folder / name for name in _POSE_FOLDERS if (folder / name).is_dir()), None)
    poses = numbered(pose_folder, scene, suffixes=(".txt",)) if pose_folder else pose_file_of(folder)
    single = [path for path in _beside(folder) if path.is_file()][:1]
    return _Files(
        layout=f"folders {color.name}/ and depth/" if (folder / "depth").is_dir() else f"images in {color.name}/",
        color=numbered(color, scene),
        depth=numbered(folder / "depth", scene),
        poses=poses,
        intrinsics=tuple(path for path in _exported_intrinsics(folder) if path.is_file()) or tuple(single),
    )


def _files_of_seven_scenes(folder: Path, scene: str) -> _Files:
    _say(f"scene {scene}: raw 7-Scenes streams are not registered; colour and depth do not match", logging.WARNING)
    # The intrinsics are next to the frames, or next to the sequences of a scene.
    candidates = [*_beside(folder), *_beside(folder.parent)]
    return _Files(
        layout="7-Scenes layout",
        color=numbered(folder, scene, "frame-*.color.*"),
        depth=numbered(folder, scene, "frame-*.depth.*"),
        poses=numbered(folder, scene, "frame-*.pose.txt", suffixes=(".txt",)),
        intrinsics=tuple(path for path in candidates if path.is_file())[:1],
    )


def _exported_intrinsics(folder: Path) -> list[Path]:
    return [folder / "intrinsic" / f"intrinsic_{kind}.txt" for kind in ("color", "depth")]


def _beside(folder: Path) -> list[Path]:
    return [folder / name for name in INTRINSICS_FILES]


def _read_poses(files: _Files, folder: Path, scene: str) -> dict[int, NDArray[np.float64]]:
    """Camera-to-world poses by frame number."""
    if files.poses is None:
        raise DataError(
            f"scene {scene} in {folder} has {len(files.color)} colour and {len(files.depth)} depth images but no "
            f"poses: add poses.txt (a line of 16 numbers, 4x4 camera-to-world, for each image), or one of "
            f"{', '.join(POSE_FILES[1:])}"
        )
    if isinstance(files.poses, dict):
        return read_poses(files.poses, scene)
    return read_pose_list(files.poses, scene, list(files.color))
