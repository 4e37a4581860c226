"""Pose lists and intrinsics files of custom recordings, in the common formats.

A damaged file, or one that does not match the images, raises ``DataError``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vg2gt.data.base import DataError
from vg2gt.data.sources.parsing import errors_name, pinhole, read_matrix, read_numbers, read_text_lines
from vg2gt.io.errors import FormatError
from vg2gt.io.json_checks import load_json

POSE_FILES = ("poses.txt", "pose.txt", "trajectory.txt", "trajectory.log", "odometry.log", "poses.log")
INTRINSICS_FILES = (
    "K.txt",
    "camera-intrinsics.txt",
    "camera_intrinsic.json",
    "camera_intrinsics.json",
    "intrinsic.json",
)
_COLUMNS = {16: "4x4 matrix", 12: "3x4 matrix", 7: "x y z qx qy qz qw", 8: "time and x y z qx qy qz qw"}
_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def pose_file_of(folder: Path) -> Path | None:
    """Returns the pose list in a recording's folder, if there is one."""
    return next((folder / name for name in POSE_FILES if (folder / name).is_file()), None)


def read_pose_list(path: Path, scene: str, frames: Sequence[int]) -> dict[int, NDArray[np.float64]]:
    """Reads camera-to-world poses ``[4, 4]`` by frame number from a file with one pose per image, in image order.

    A line holds a 4x4 or 3x4 matrix, or a position and a quaternion (x y z w) with or without a preceding timestamp. A
    ``.log`` file has five lines per image, as in Open3D, Redwood and Tanks and Temples.
    """
    if path.suffix == ".log":
        found = [np.full((4, 4), np.nan) if pose is None else pose for pose in read_log(path, scene)]
        if len(found) != len(frames):
            raise DataError(f"{path} of scene {scene} has {len(found)} poses for {len(frames)} images")
        return dict(zip(frames, found, strict=True))
    rows = read_numbers(path, scene)
    if rows.shape[1] not in _COLUMNS or len(rows) != len(frames):
        raise DataError(
            f"{path} of scene {scene} must have one line of 16 numbers (4x4 camera-to-world; or "
            f"{', '.join(f'{count}: {text}' for count, text in list(_COLUMNS.items())[1:])}) for each of the "
            f"{len(frames)} images; it has {len(rows)} lines of {rows.shape[1]}"
        )
    return dict(zip(frames, pose_matrices(rows), strict=True))


def read_log(path: Path, scene: str) -> list[NDArray[np.float64] | None]:
    """Reads a ``.log`` trajectory: per image, a line of three integers and a 4x4 camera-to-world matrix.

    Returns:
        The matrices in file order; None for images that are not registered (negative second integer).
    """
    rows = [line.split() for line in read_text_lines(path, scene)]
    if not rows or len(rows) % 5:
        raise DataError(f"{path} of scene {scene} has {len(rows)} lines; expected five for each image")
    poses: list[NDArray[np.float64] | None] = []
    for start in range(0, len(rows), 5):
        header, matrix = rows[start], rows[start + 1 : start + 5]
        try:
            numbers = [int(word) for word in header]
            values = np.array([[float(word) for word in row] for row in matrix])
        except ValueError as error:
            raise DataError(f"{path} of scene {scene}, image {start // 5}: {error}") from error
        if len(numbers) != 3 or values.shape != (4, 4):
            raise DataError(f"{path} of scene {scene}, image {start // 5}: expected 3 numbers and a 4x4 matrix")
        poses.append(None if numbers[1] < 0 else values)
    return poses


def read_camera(path: Path, scene: str) -> tuple[NDArray[np.float64], bool]:
    """Reads intrinsics ``[3, 3]`` with positive fy, and whether the y axis points up (negative fy, as in ICL-NUIM).

    The file holds a 3x3 or 4x4 matrix or one line ``fx fy cx cy``, or is Open3D's ``camera_intrinsic.json``.
    """
    if path.suffix == ".json":
        with errors_name(scene):
            matrix = _open3d_matrix(path)
    else:
        matrix = read_matrix(path, scene, ((3, 3), (4, 4), (1, 4)))
        matrix = pinhole(*matrix[0]) if matrix.shape == (1, 4) else matrix[:3, :3].copy()
    upwards = bool(matrix[1, 1] < 0)
    matrix[1, 1] = abs(matrix[1, 1])
    return matrix, upwards


def mirrored(poses: dict[int, NDArray[np.float64]]) -> dict[int, NDArray[np.float64]]:
    """Flips the y axes of both camera and world; rotations remain rotations."""
    return {frame: _MIRROR @ pose @ _MIRROR for frame, pose in poses.items()}


def pose_matrices(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Converts rows to poses ``[n, 4, 4]``: a 4x4 or 3x4 matrix, or x y z qx qy qz qw, optionally after a timestamp.

    An invalid quaternion gives a pose of NaN.
    """
    count = rows.shape[1]
    if count == 16:
        return rows.reshape(-1, 4, 4)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    if count == 12:
        poses[:, :3] = rows.reshape(-1, 3, 4)
        return poses
    numbers = rows[:, -7:]
    good = np.isfinite(numbers).all(1) & (np.linalg.norm(numbers[:, 3:], axis=1) > 0.5)
    poses[~good] = np.nan
    poses[good, :3, :3] = Rotation.from_quat(numbers[good, 3:]).as_matrix()
    poses[good, :3, 3] = numbers[good, :3]
    return poses


def _open3d_matrix(path: Path) -> NDArray[np.float64]:
    """Reads ``intrinsic_matrix``: nine numbers in column-major order."""
    content = load_json(path)
    numbers = content.get("intrinsic_matrix") if isinstance(content, dict) else None
    if not isinstance(numbers, list) or len(numbers) != 9 or not all(type(n) in (int, float) for n in numbers):
        raise FormatError(f"{path}: expected Open3D's intrinsic_matrix of nine numbers, column by column")
    return np.array(numbers, np.float64).reshape(3, 3).T.copy()
