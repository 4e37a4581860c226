"""Finds RGB-D recordings on disk and reads everything but the images: file lists, poses, intrinsics.

Layouts, told apart by what is there:

* folders: colour in ``images/``, ``color/`` or ``rgb/``, depth in ``depth/``, poses in ``poses.txt`` (16 numbers a
  line, in the order of the images) or one text file a frame in ``pose/`` or ``poses/``, intrinsics in ``K.txt`` (3x3)
  or in ``intrinsic/intrinsic_{color,depth}.txt`` (4x4, exported ScanNet);
* 7-Scenes: ``frame-NNNNNN.{color.png|jpg,depth.png,pose.txt}`` in one folder, intrinsics in ``camera-intrinsics.txt``.
  Raw 7-Scenes streams are not registered: colour and depth are a few hundredths of the image apart.

Poses are camera-to-world, OpenCV, metres. Frames are sorted by the number in their file name, not by its letters.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from vg2gt.data.base import DataError
from vg2gt.data.image_files import image_size
from vg2gt.geometry.cameras import resize_intrinsics

log = logging.getLogger(__name__)

_COLOR_FOLDERS = ("images", "color", "rgb")
_POSE_FOLDERS = ("pose", "poses")
_INTRINSICS_FILES = ("K.txt", "camera-intrinsics.txt")
_IMAGES = (".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".tif", ".tiff", ".webp", ".bmp")
_ROTATION_TOLERANCE = 0.02

Size = tuple[int, int]


@dataclass(frozen=True)
class Recording:
    """One RGB-D recording; row i of everything belongs to frame ``frame_ids[i]``.

    Attributes:
        name: the scene's name.
        folder: where it is.
        layout: which layout was recognised.
        frame_ids: increasing numbers of the frames.
        color: colour image files.
        depth: depth image files.
        world_to_camera: ``[n, 4, 4]`` float64.
        intrinsics: ``[3, 3]`` of the depth images.
        color_size: ``(height, width)`` of the colour images.
        depth_size: of the depth images.
        dropped: frames left out because their pose is not finite.
    """

    name: str
    folder: Path
    layout: str
    frame_ids: tuple[int, ...]
    color: tuple[Path, ...]
    depth: tuple[Path, ...]
    world_to_camera: NDArray[np.floating]
    intrinsics: NDArray[np.float64]
    color_size: Size
    depth_size: Size
    dropped: int

    def __str__(self) -> str:
        height, width = self.depth_size
        return f"scene {self.name}: {self.layout}, {len(self.frame_ids)} frames of {width}x{height} in {self.folder}"

    def row(self, frame: int) -> int:
        """Position of a frame."""
        return self.frame_ids.index(frame)


@dataclass(frozen=True)
class _Files:
    """The files of a recording, by frame number where there is one file a frame."""

    layout: str
    color: dict[int, Path]
    depth: dict[int, Path]
    poses: dict[int, Path] | Path
    intrinsics: tuple[Path, ...]


def find_recordings(roots: Sequence[Path], intrinsics: tuple[float, ...] | None) -> list[Recording]:
    """Reads the recordings in folders: each is one itself, or holds some one or two levels down.

    Args:
        roots: existing folders.
        intrinsics: (fx, fy, cx, cy) of the colour images, in place of the files'.

    Raises:
        DataError: if a folder holds no recording or an incomplete one; names the folder or file.
    """
    found = []
    for root in roots:
        if _is_recording(root):
            found.append(_read(root, root.resolve().name, intrinsics))
            continue
        inner = [folder for pattern in ("*", "*/*") for folder in sorted(root.glob(pattern)) if _is_recording(folder)]
        if not inner:
            raise DataError(
                f"no RGB-D recording in {root}: expected {'/, '.join(_COLOR_FOLDERS)}/ with depth/, or "
                "frame-*.color.png with frame-*.depth.png, there or up to two folders deeper"
            )
        found += [_read(folder, folder.relative_to(root).as_posix(), intrinsics) for folder in inner]
    return found


def _is_recording(folder: Path) -> bool:
    in_folders = (folder / "depth").is_dir() and any((folder / name).is_dir() for name in _COLOR_FOLDERS)
    return folder.is_dir() and (in_folders or any(folder.glob("frame-*.color.*")))


def _read(folder: Path, scene: str, given: tuple[float, ...] | None) -> Recording:
    files = _files_in_folders(folder, scene) if (folder / "depth").is_dir() else _files_of_seven_scenes(folder, scene)
    if not files.color:
        raise DataError(f"scene {scene} has no colour images in {folder}")
    _check_same_frames(folder, scene, "colour", files.color, "depth", files.depth)
    numbers = sorted(files.color)
    poses = _read_poses(files.poses, numbers, folder, scene)
    finite = np.array([np.isfinite(pose).all() for pose in poses])
    if not finite.any():
        raise DataError(f"no frame of scene {scene} in {folder} has a finite pose")
    if not finite.all():
        log.warning(
            "scene %s: %d of %d frames have no finite pose and are left out", scene, (~finite).sum(), len(poses)
        )
    kept = [number for number, good in zip(numbers, finite, strict=True) if good]
    color_size = image_size(files.color[kept[0]], scene)
    depth_size = image_size(files.depth[kept[0]], scene)
    _check_shapes(scene, folder, color_size, depth_size)
    return Recording(
        name=scene,
        folder=folder,
        layout=files.layout,
        frame_ids=tuple(kept),
        color=tuple(files.color[number] for number in kept),
        depth=tuple(files.depth[number] for number in kept),
        world_to_camera=np.linalg.inv(_orthonormal(poses[finite], kept, folder, scene)),
        intrinsics=_depth_intrinsics(files.intrinsics, given, folder, scene, color_size, depth_size),
        color_size=color_size,
        depth_size=depth_size,
        dropped=int((~finite).sum()),
    )


def _files_in_folders(folder: Path, scene: str) -> _Files:
    color = next(folder / name for name in _COLOR_FOLDERS if (folder / name).is_dir())
    pose_folder = next((folder / name for name in _POSE_FOLDERS if (folder / name).is_dir()), None)
    poses = _numbered(pose_folder, "*.txt", scene) if pose_folder else folder / "poses.txt"
    exported = [folder / "intrinsic" / f"intrinsic_{kind}.txt" for kind in ("color", "depth")]
    single = [folder / name for name in _INTRINSICS_FILES if (folder / name).is_file()][:1]
    return _Files(
        layout="exported ScanNet layout" if (folder / "intrinsic").is_dir() else f"folders {color.name}/ and depth/",
        color=_numbered(color, "*", scene),
        depth=_numbered(folder / "depth", "*", scene),
        poses=poses,
        intrinsics=tuple(path for path in exported if path.is_file()) or tuple(single),
    )


def _files_of_seven_scenes(folder: Path, scene: str) -> _Files:
    log.warning("scene %s: raw 7-Scenes streams are not registered; colour and depth do not match exactly", scene)
    # The intrinsics lie beside the frames, or beside the sequences of a scene.
    candidates = [place / name for place in (folder, folder.parent) for name in _INTRINSICS_FILES]
    return _Files(
        layout="7-Scenes layout",
        color=_numbered(folder, "frame-*.color.*", scene),
        depth=_numbered(folder, "frame-*.depth.*", scene),
        poses=_numbered(folder, "frame-*.pose.txt", scene),
        intrinsics=tuple(path for path in candidates if path.is_file())[:1],
    )


def _numbered(folder: Path, pattern: str, scene: str) -> dict[int, Path]:
    """Files by the last number in their name (before the first dot); hidden and other kinds of files are ignored."""
    files: dict[int, Path] = {}
    for path in sorted(folder.glob(pattern)):
        if path.name.startswith(".") or path.suffix.lower() not in (*_IMAGES, ".txt"):
            continue
        digits = re.findall(r"\d+", path.name.split(".")[0])
        if not digits:
            raise DataError(f"{path} of scene {scene} has no frame number in its name")
        number = int(digits[-1])
        if number in files:
            raise DataError(f"{files[number]} and {path} of scene {scene} have the same frame number {number}")
        files[number] = path
    return files


def _check_same_frames(
    folder: Path, scene: str, a: str, first: Collection[int], b: str, second: Collection[int]
) -> None:
    """Both kinds of file, called ``a`` and ``b``, must be there for the same frame numbers."""
    lone = sorted(set(first) ^ set(second))
    if lone:
        where, other = (a, b) if lone[0] in first else (b, a)
        raise DataError(
            f"scene {scene} in {folder} has {len(first)} {a} and {len(second)} {b} files: frame {lone[0]} has a "
            f"{where} file but no {other} file"
        )


def _read_poses(source: dict[int, Path] | Path, numbers: list[int], folder: Path, scene: str) -> NDArray[np.float64]:
    """Camera-to-world poses ``[n, 4, 4]`` in the order of ``numbers``; possibly not finite."""
    if isinstance(source, dict):
        _check_same_frames(folder, scene, "colour", numbers, "pose", source)
        return np.stack([_read_matrix(source[number], scene, ((4, 4),)) for number in numbers])
    rows = _read_numbers(source, scene)
    if rows.shape != (len(numbers), 16):
        raise DataError(
            f"{source} of scene {scene} must have one line of 16 numbers (4x4 camera-to-world) for each of the "
            f"{len(numbers)} images; it has {rows.shape[0]} lines of {rows.shape[1]}"
        )
    return rows.reshape(-1, 4, 4)


def _read_numbers(path: Path, scene: str) -> NDArray[np.float64]:
    try:
        return np.loadtxt(path, dtype=np.float64, ndmin=2)
    except (OSError, ValueError) as error:
        raise DataError(f"cannot read {path} of scene {scene}: {error}") from error


def _read_matrix(path: Path, scene: str, shapes: tuple[Size, ...]) -> NDArray[np.float64]:
    matrix = _read_numbers(path, scene)
    if matrix.shape not in shapes:
        expected = " or ".join(f"{rows}x{columns}" for rows, columns in shapes)
        raise DataError(
            f"{path} of scene {scene} must hold a {expected} matrix, not {matrix.shape[0]}x{matrix.shape[1]}"
        )
    return matrix


def _orthonormal(poses: NDArray[np.float64], numbers: list[int], folder: Path, scene: str) -> NDArray[np.float64]:
    """Replaces rotations, which recordings give to a few digits, by the nearest exact ones."""
    rotations = poses[:, :3, :3]
    error = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max((1, 2))
    bad = (
        (error > _ROTATION_TOLERANCE)
        | (np.linalg.det(rotations) < 0)
        | (np.abs(poses[:, 3] - [0, 0, 0, 1]).max(1) > 1e-3)
    )
    if bad.any():
        raise DataError(
            f"the pose of frame {numbers[int(bad.argmax())]} of scene {scene} in {folder} is not a rigid "
            "camera-to-world transform (rotation and translation over a row 0 0 0 1)"
        )
    left, _, right = np.linalg.svd(rotations)
    exact = np.tile(np.eye(4), (len(poses), 1, 1))
    exact[:, :3, :3] = left @ right
    exact[:, :3, 3] = poses[:, :3, 3]
    return exact


def _depth_intrinsics(
    files: tuple[Path, ...], given: tuple[float, ...] | None, folder: Path, scene: str, color: Size, depth: Size
) -> NDArray[np.float64]:
    """Intrinsics of the depth images: their own file, or the colour images' brought to their size."""
    own = [path for path in files if path.name == "intrinsic_depth.txt"]
    if given is None and not files:
        raise DataError(
            f"scene {scene} in {folder} has no intrinsics: add K.txt (3x3) or set data.intrinsics=[fx,fy,cx,cy]"
        )
    if given is not None:
        fx, fy, cx, cy = given
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)
    else:
        matrix = _read_matrix((own or files)[0], scene, ((3, 3), (4, 4)))[:3, :3].copy()
    if not (np.isfinite(matrix).all() and matrix[0, 0] > 0 and matrix[1, 1] > 0):
        raise DataError(
            f"the intrinsics of scene {scene} in {folder} have no positive focal lengths: {matrix.tolist()}"
        )
    if given is not None or not own:
        matrix = resize_intrinsics(torch.from_numpy(matrix), depth[1] / color[1], depth[0] / color[0]).numpy()
    return matrix


def _check_shapes(scene: str, folder: Path, color: Size, depth: Size) -> None:
    if abs(color[0] * depth[1] / (color[1] * depth[0]) - 1) > 0.02:
        raise DataError(
            f"colour ({color[1]}x{color[0]}) and depth ({depth[1]}x{depth[0]}) of scene {scene} in {folder} have "
            "different aspect ratios: they are not registered"
        )
