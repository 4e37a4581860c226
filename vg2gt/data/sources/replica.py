"""Replica, as rendered for NICE-SLAM."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from typing_extensions import Unpack

from vg2gt.data.base import DataError
from vg2gt.data.sources.files import FileSource, HoldoutOptions
from vg2gt.data.sources.index import SceneIndex, check_found, first_size, make_index
from vg2gt.data.sources.parsing import four_intrinsics, numbered, pinhole, read_numbers

_SIZE = (680, 1200)


class Replica(FileSource):
    """The eight rooms and offices of Replica, one video each; a scene is a folder such as ``office0``.

    A scene has ``results/frameNNNNNN.jpg`` and ``results/depthNNNNNN.png`` (6553.5 units per metre, 0 = none). Line N
    of ``traj.txt`` holds the 16 numbers of the camera-to-world matrix of frame N (OpenCV, metres). Images are 1200x680
    with a focal length of 600 and the principal point in the centre, (599.5, 339.5).

    Args:
        root: the folder of the scenes, a single scene, or a list of these.
        intrinsics: (fx, fy, cx, cy) in pixels of the images, if they have another size or camera; None: Replica's.
        shared: see ``FileSource``; a video has 2000 closely spaced frames.
    """

    layout = "SCENE/traj.txt and SCENE/results/{frame,depth}*, there or up to two folders deeper"
    scene_marks = ("results",)
    index_options = ("intrinsics",)
    depth_scale = 6553.5

    def __init__(
        self,
        root: str | Sequence[str] | None,
        intrinsics: Sequence[float] | None = None,
        **shared: Unpack[HoldoutOptions],
    ) -> None:
        self.intrinsics = four_intrinsics(intrinsics)
        super().__init__(root, **shared)

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Lists the files of a scene and reads its poses."""
        color, depth = (numbered(folder / "results", scene, f"{kind}*") for kind in ("frame", "depth"))
        check_found(scene, folder / "results", {"frame images": color, "depth images": depth})
        path, last = folder / "traj.txt", max(color)
        rows = read_numbers(path, scene)
        if rows.shape[1] != 16 or len(rows) <= last:
            raise DataError(
                f"{path} of scene {scene} must have a line of 16 numbers (4x4 camera-to-world) for each of the frames "
                f"0 to {last}; it has {rows.shape[0]} lines of {rows.shape[1]}"
            )
        poses = dict(enumerate(rows[: last + 1].reshape(-1, 4, 4)))
        size = first_size(color, scene)
        if self.intrinsics is None and size != _SIZE:
            raise DataError(
                f"the images of scene {scene} in {folder} are {size[1]}x{size[0]}, not 1200x680: another camera "
                "rendered them; set data.intrinsics=[fx,fy,cx,cy]"
            )
        intrinsics = pinhole(*(self.intrinsics or (600.0, 600.0, 599.5, 339.5)))
        return make_index(scene, folder, color, depth, poses, intrinsics)
