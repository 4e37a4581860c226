"""ScanNet++: undistorted iPhone frames, with depth rendered from the laser scan."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from vg2gt.data.base import DataError
from vg2gt.data.sources.files import FileSource
from vg2gt.data.sources.index import SceneIndex, check_found, make_index
from vg2gt.data.sources.parsing import CORNER_TO_CENTER, numbered
from vg2gt.io.arrays import load_matrices, load_npz

METADATA = "scene_iphone_metadata.npz"
"""File with the cameras of a scene."""


class ScanNetPPiPhone(FileSource):
    """Preprocessed scenes of ScanNet++, as in InsScene-15K's ``processed_scannetpp_v2``; iPhone frames only.

    A scene has ``images/frame_NNNNNN.jpg``, ``depth/frame_NNNNNN.png`` (same size, millimetres, 0 = unknown) and
    ``scene_iphone_metadata.npz`` with ``images`` [N] (file names), ``trajectories`` [N, 4, 4] (camera-to-world, OpenCV)
    and ``intrinsics`` [N, 3, 3]. Principal points have COLMAP's pixel corners at integers, so 1/2 is subtracted. DSLR
    frames in the same folders are ignored. The id of a frame is its number.

    The arguments are those of ``FileSource``. ``root`` is a scene, a folder of scenes, a folder of splits with scenes,
    or a list of these. ``scenes`` may be the official ``nvs_sem_train.txt``.
    """

    scene_marks = (METADATA,)
    layout = f"SCENE/{{images,depth}} and SCENE/{METADATA}, there or up to two folders deeper"

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Reads the cameras and finds their images."""
        path = folder / METADATA
        names = load_npz(path, scene, ("images",))["images"]
        if names.ndim != 1 or names.dtype.kind not in "US":
            raise DataError(f"images in {path} of scene {scene} must be a list of file names, not {names.dtype}")
        shapes = {"trajectories": (len(names), 4, 4), "intrinsics": (len(names), 3, 3)}
        matrices = load_matrices(path, scene, shapes)
        frames = _frame_numbers(names.astype(str), path, scene)
        images = numbered(folder / "images", scene, "frame_*")
        depth = numbered(folder / "depth", scene, "frame_*")
        color = {number: images[number] for number in frames if number in images}
        check_found(scene, folder, {"images of iPhone frames": color, "depth of iPhone frames": depth})
        return make_index(
            scene,
            folder,
            color,
            depth={number: file for number, file in depth.items() if number in frames},
            camera_to_world={number: matrices["trajectories"][row] for number, row in frames.items()},
            intrinsics={number: matrices["intrinsics"][row] - CORNER_TO_CENTER for number, row in frames.items()},
        )


def _frame_numbers(names: NDArray[np.str_], path: Path, scene: str) -> dict[int, int]:
    """Rows of the metadata by frame number."""
    rows: dict[int, int] = {}
    for row, name in enumerate(names.tolist()):
        digits = PurePosixPath(name).stem.removeprefix("frame_")
        if not digits.isascii() or not digits.isdigit():
            raise DataError(f"{path} of scene {scene} names an image {name!r}; expected frame_NNNNNN.jpg")
        if int(digits) in rows:
            raise DataError(f"{path} of scene {scene} names frame {int(digits)} twice")
        rows[int(digits)] = row
    return rows
