"""TUM RGB-D: Kinect recordings with poses from motion capture."""

from __future__ import annotations

import os.path
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from typing_extensions import Unpack

from vg2gt.data.base import DataError
from vg2gt.data.sources.files import FileOptions, FileSource
from vg2gt.data.sources.index import SceneIndex, make_index
from vg2gt.data.sources.parsing import (
    four_intrinsics,
    named_file,
    pinhole,
    read_matrix,
    read_numbers,
    read_text_lines,
)

INTRINSICS = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3),
    "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}
"""Calibrated (fx, fy, cx, cy) of the 640x480 colour images of the three Kinects."""

_CAMERA = re.compile(r"(?:freiburg|fr)([123])(?!\d)")
_SHORTEST_QUATERNION = 0.5


class TUM(FileSource):
    """Sequences of the TUM RGB-D benchmark, and recordings in its layout; a scene is a sequence.

    ``rgb.txt`` and ``depth.txt`` have lines of ``timestamp path``, ``groundtruth.txt`` of ``timestamp tx ty tz qx qy qz
    qw`` (camera-to-world, OpenCV, metres). Each colour image is associated with a depth image and a pose whose times
    differ by at most ``max_difference``, closest pairs first, and each is used at most once. Frame ids are positions in
    ``rgb.txt``, ordered by time. Depth is registered to the colour camera, 5000 units per metre; 0 and 65535 mean
    unknown. Listed files that do not exist are left out and counted.

    By default, intrinsics are those of the Kinect in the folder's name (``freiburg1``, ``fr1``, ...). Images are
    treated as those of a pinhole camera. Images of freiburg3 are undistorted. Those of freiburg1 and freiburg2 are not:
    with the published coefficients, half of their pixels are off by more than 5 pixels, a tenth by more than 8, and the
    corners by 15 to 37. Undistort them beforehand if that matters.

    Args:
        root: a sequence, a folder of sequences, or a list of these.
        intrinsics: (fx, fy, cx, cy) in pixels of the colour images; None reads ``K.txt`` next to the lists, or else
            uses the folder's name.
        max_difference: maximum time difference within a frame, in seconds.
        holdout: hold out every N-th frame as an evaluation target; None for none.
        shared: see ``FileSource``; the camera records 30 frames per second.
    """

    recorded = True
    layout = "rgb.txt, depth.txt and groundtruth.txt, there or up to two folders deeper"
    scene_marks = ("rgb.txt",)
    index_options = ("intrinsics", "max_difference")
    depth_scale = 5000.0
    invalid = (65535,)

    def __init__(
        self,
        root: str | Sequence[str] | None,
        intrinsics: Sequence[float] | None = None,
        max_difference: float = 0.02,
        holdout: int | None = 6,
        **shared: Unpack[FileOptions],
    ) -> None:
        self.intrinsics = four_intrinsics(intrinsics)
        self.max_difference = max_difference
        super().__init__(root, holdout=holdout, **shared)

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Reads the lists and associates their entries."""
        if not (folder / "groundtruth.txt").is_file():
            raise DataError(
                f"scene {scene} in {folder} has no groundtruth.txt (lines of 'timestamp tx ty tz qx qy qz qw'), so its "
                "poses are not known; add the file, or reconstruct the images as a folder without poses"
            )
        times, files = _read_list(folder / "rgb.txt", scene)
        depth_times, depth_files = _read_list(folder / "depth.txt", scene)
        pose_times, poses = _read_poses(folder / "groundtruth.txt", scene)
        depth = associate(times, depth_times, self.max_difference)
        pose = associate(times, pose_times, self.max_difference)
        color = {i: file for i, file in enumerate(files) if os.path.isfile(file)}
        depth_paths = {i: depth_files[j] for i, j in depth.items()}
        depth_paths = {i: path for i, path in depth_paths.items() if os.path.isfile(path)}
        if not color or not depth_paths:
            raise DataError(
                f"scene {scene} in {folder} has no {'colour' if not color else 'depth'} images: none of those listed "
                f"in {'rgb' if not color else 'depth'}.txt exists or belongs to a frame"
            )
        intrinsics = pinhole(*self._camera(scene, folder))
        return make_index(scene, folder, color, depth_paths, {i: poses[j] for i, j in pose.items()}, intrinsics)

    def _camera(self, scene: str, folder: Path) -> tuple[float, ...]:
        named = _CAMERA.search(scene)
        if self.intrinsics is not None:
            return self.intrinsics
        if (folder / "K.txt").is_file():
            matrix = read_matrix(folder / "K.txt", scene, ((3, 3),))
            return matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
        if named is None:
            raise DataError(
                f"the intrinsics of scene {scene} in {folder} are not known: its name says neither freiburg1 nor "
                "freiburg2 nor freiburg3; add K.txt (3x3), or set data.intrinsics=[fx,fy,cx,cy]"
            )
        return INTRINSICS[f"freiburg{named[1]}"]


def associate(times: NDArray[np.float64], others: NDArray[np.float64], max_difference: float) -> dict[int, int]:
    """Pairs the entries of two increasing lists of times, closest pairs first, each entry at most once.

    Returns:
        Indices into ``others`` by index into ``times``.
    """
    first = np.searchsorted(others, times - max_difference, "left")
    last = np.searchsorted(others, times + max_difference, "right")
    near = [(i, j) for i in range(len(times)) for j in range(first[i], last[i])]
    pairs: dict[int, int] = {}
    used: set[int] = set()
    for i, j in sorted(near, key=lambda pair: abs(times[pair[0]] - others[pair[1]])):
        if i not in pairs and j not in used:
            pairs[i] = j
            used.add(j)
    return pairs


def _read_list(path: Path, scene: str) -> tuple[NDArray[np.float64], list[Path]]:
    """Increasing times and their files, whose paths are relative to the list."""
    entries: dict[float, str] = {}
    for line in read_text_lines(path, scene):
        words = line.split(maxsplit=1)
        time = _number(words[0])
        if len(words) < 2 or not np.isfinite(time):
            raise DataError(f"{path} of scene {scene} must have lines of 'timestamp path', not {line!r}")
        if time in entries:
            raise DataError(f"{path} of scene {scene} lists {words[0]} twice")
        entries[time] = words[1]
    if not entries:
        raise DataError(f"{path} of scene {scene} lists no file")
    times = sorted(entries)
    where = f"{path} of scene {scene}"
    return np.array(times), [named_file(path.parent, entries[time], where) for time in times]


def _read_poses(path: Path, scene: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Increasing times and camera-to-world poses ``[n, 4, 4]``; NaN for invalid numbers or a short quaternion."""
    rows = read_numbers(path, scene)
    if rows.shape[1] != 8:
        raise DataError(
            f"{path} of scene {scene} must have lines of 'timestamp tx ty tz qx qy qz qw', not {rows.shape[1]} numbers"
        )
    rows = rows[np.isfinite(rows[:, 0])]
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    poses = np.full((len(rows), 4, 4), np.nan)
    good = np.isfinite(rows).all(1) & (np.linalg.norm(rows[:, 4:], axis=1) > _SHORTEST_QUATERNION)
    poses[good] = np.eye(4)
    poses[good, :3, :3] = Rotation.from_quat(rows[good, 4:]).as_matrix()
    poses[good, :3, 3] = rows[good, 1:4]
    return rows[:, 0], poses


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return np.nan
