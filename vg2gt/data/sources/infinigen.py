"""Infinigen: procedural scenes as rendered by Infinigen or exported by InsScene-15K."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Unpack

from vg2gt.data.base import DataError
from vg2gt.data.sources.files import FileSource, HoldoutOptions
from vg2gt.data.sources.index import SceneIndex, check_found, make_index
from vg2gt.data.sources.parsing import CORNER_TO_CENTER
from vg2gt.io.arrays import load_matrices, load_npy, npy_size
from vg2gt.io.image_files import Size

_RIG_STEP = 100_000
_CAMERA_STEP = 1_000_000_000
_FILES = {"Image": (".png", ".jpg"), "Depth": (".npy",), "camview": (".npz",)}
_NAME = re.compile(r"_(\d+)_(\d+)_(\d+)_(\d+)$")

_View = tuple[int, int, int]  # camera, rig, frame


class Infinigen(FileSource):
    """Scenes rendered by Infinigen: a scene is a folder with ``frames/{Image,Depth,camview}/camera_0``.

    Files are ``{Image,Depth,camview}_{rig}_{resample}_{frame:04d}_{camera}.{png,npy,npz}``; images may be JPEG
    (``.jpg``). Resamples show the same view with other materials; the first one is used. Frame ids depend on the scene:

    * one rig (a video): the frame number;
    * one frame seen by many rigs (InsScene-15K): the rig number;
    * several of both: ``100000 rig + frame``.

    A rig of Infinigen has two cameras, 7.5 cm apart, in ``camera_0`` and ``camera_1``. The ids of camera c are offset
    by ``10^9 c``.

    The camview files hold ``T``, camera-to-world in OpenCV axes, and ``K``, whose principal point is (W/2, H/2) in
    Blender's convention: 1/2 is subtracted. Depth is z-depth in metres (verified with Infinigen 1.15.5), at the size of
    the images or twice that (the OpenGL annotations), and then reduced to every second pixel. The centre of an image
    pixel lies between four depth pixels. The lower right one is used, 1/4 of an image pixel away, because their mean
    would be a point in mid-air at edges.

    Args:
        root: a scene, a folder of scenes up to two levels deep, or a list of these. Scenes in the same subfolder of
            ``root`` count as one place, see ``place``.
        max_depth: points farther than this (metres) have no depth, nor has the sky, whose depth is infinite or huge. A
            frame without any nearer point has no valid depth: training replaces it, evaluation raises an error.
        cameras: cameras of a rig to use. ``holdout`` holds out the same frames of all of them.
        shared: see ``FileSource``.
    """

    layout = "SCENE/frames/{Image,Depth,camview}/camera_0, there or up to two folders deeper"
    scene_marks = ("frames/Image/camera_0",)
    names_are_paths = True
    index_options = ("cameras",)

    def __init__(
        self,
        root: str | Sequence[str] | None,
        max_depth: float = 30.0,
        cameras: Sequence[int] = (0,),
        **shared: Unpack[HoldoutOptions],
    ) -> None:
        self.max_depth = max_depth
        self.cameras = tuple(cameras)
        if not self.cameras or len(set(self.cameras)) < len(self.cameras) or min(self.cameras) < 0:
            raise ValueError(f"cameras must be different numbers of a rig's cameras, such as [0, 1]; got {cameras}")
        super().__init__(root, **shared)

    def find(self, root: Path) -> Mapping[str, Path]:
        """Finds the ``frames`` folders of scenes, by the path of the scene."""
        return {name: folder / "frames" for name, folder in super().find(root).items()}

    def place(self, scene: str) -> str:
        """Returns the first folder of the path, because InsScene-15K stores several parts of a scene in one folder.

        Infinigen's renderer writes ``JOB/SEED/frames``, where every seed is a separate world. Pass the job folders as
        ``root``, so that every seed counts as a place.
        """
        return scene.split("/")[0]

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Lists the files of a scene and reads its cameras."""
        color, depth, cameras = (
            {
                view: path
                for camera in self.cameras
                for view, path in _views(folder / kind, kind, suffixes, camera, scene)
            }
            for kind, suffixes in _FILES.items()
        )
        check_found(scene, folder, {"Image files": color, "Depth files": depth})
        ids = _frame_ids({*color, *depth, *cameras})
        matrices = {ids[view]: load_matrices(path, scene, {"K": (3, 3), "T": (4, 4)}) for view, path in cameras.items()}
        return make_index(
            scene,
            folder,
            color={ids[view]: path for view, path in color.items()},
            depth={ids[view]: path for view, path in depth.items()},
            camera_to_world={frame: matrix["T"] for frame, matrix in matrices.items()},
            intrinsics={frame: matrix["K"] - CORNER_TO_CENTER for frame, matrix in matrices.items()},
            depth_size=npy_size(next(iter(depth.values())), scene),
        )

    def held_out(self, scene: str) -> Sequence[int]:
        """Returns every ``holdout``-th frame, for all cameras."""
        if not self.holdout:
            return ()
        shown = sorted({frame % _CAMERA_STEP for frame in self.frames(scene)})
        chosen = set(shown[self.holdout // 2 :: self.holdout])
        return tuple(frame for frame in self.frames(scene) if frame % _CAMERA_STEP in chosen)

    def read_depth(self, index: SceneIndex, row: int, size: Size) -> NDArray[np.float32]:
        """Reads depth; values beyond ``max_depth`` or NaN become 0."""
        depth = load_npy(index.depth[row], index.name, size)
        return np.where((depth > 0) & (depth <= self.max_depth), depth, np.float32(0))


def _views(folder: Path, kind: str, suffixes: tuple[str, ...], camera: int, scene: str) -> Iterator[tuple[_View, Path]]:
    """Yields (camera, rig, frame) and file of one kind and camera, sorted; only the first resample of each view."""
    found: dict[tuple[int, ...], Path] = {}
    for path in sorted((folder / f"camera_{camera}").glob(f"{kind}_*")):
        if path.suffix not in suffixes:
            continue
        name = _NAME.search(path.stem)
        if name is None:
            names = " or ".join(f"{kind}_RIG_RESAMPLE_FRAME_CAMERA{suffix}" for suffix in suffixes)
            raise DataError(f"{path} of scene {scene} is not named {names}")
        rig, resample, frame, _ = map(int, name.groups())
        found.setdefault((rig, frame, resample), path)
    taken: set[_View] = set()
    for rig, frame, resample in sorted(found):
        view = (camera, rig, frame)
        if view not in taken:
            taken.add(view)
            yield view, found[rig, frame, resample]


def _frame_ids(views: set[_View]) -> dict[_View, int]:
    rigs, frames = ({view[i] for view in views} for i in (1, 2))
    if len(rigs) == 1:
        rig_step, frame_step = 0, 1
    else:
        rig_step, frame_step = (1, 0) if len(frames) == 1 else (_RIG_STEP, 1)
    return {view: _CAMERA_STEP * view[0] + rig_step * view[1] + frame_step * view[2] for view in views}
