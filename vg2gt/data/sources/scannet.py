"""ScanNet, exported to image files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from vg2gt.data.sources.files import FileSource
from vg2gt.data.sources.index import SceneIndex, check_found, first_size, make_index
from vg2gt.data.sources.parsing import numbered, read_matrix, read_poses

INTRINSICS = "intrinsic/intrinsic_depth.txt"
"""File with the intrinsics of a scan's depth images."""


class ScanNet(FileSource):
    """Scans exported from ScanNet's ``.sens`` files; a scene is a scan such as ``scene0000_00``.

    A scan has ``color/N.jpg`` (1296x968), ``depth/N.png`` (640x480, millimetres, 0 = none), ``pose/N.txt`` (4x4
    camera-to-world) and ``intrinsic/intrinsic_depth.txt`` (4x4). Numbers are not padded. Frames with lost tracking have
    a pose of -inf and are left out. Colour is registered to depth: it is resized to the depth images, whose intrinsics
    are used. The extrinsics between the two cameras are the identity and are not read.

    The arguments are those of ``FileSource``. ``root`` is ScanNet's folder, its ``scans``, a single scan, or a list of
    these. ``scenes`` may be the official ``scannetv2_train.txt``. The frame rate is 30 frames per second.
    """

    scene_marks = ("color", "depth", "pose")
    layout = "sceneNNNN_NN/{color,depth,pose,intrinsic}, there or up to two folders deeper"

    def place(self, scene: str) -> str:
        """Returns the room: ``scene0000`` for ``scene0000_00`` and ``scene0000_01``."""
        return room_of_scan(scene)

    def watched(self, scene: str, folder: Path) -> Sequence[Path | None]:
        """Returns the scan's folder and its file of intrinsics."""
        return folder, folder / INTRINSICS

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Lists the files of a scan and reads its poses and intrinsics."""
        color, depth = numbered(folder / "color", scene), numbered(folder / "depth", scene)
        check_found(scene, folder, {"colour images": color, "depth images": depth})
        poses = read_poses(numbered(folder / "pose", scene, suffixes=(".txt",)), scene)
        intrinsics = read_matrix(folder / INTRINSICS, scene, ((4, 4),))[:3, :3]
        size = first_size(depth, scene)
        return make_index(scene, folder, color, depth, poses, intrinsics, size=size, depth_size=size)


def room_of_scan(scene: str) -> str:
    """Returns the room of a scan; rooms are scanned several times, as ``scene0000_00``, ``scene0000_01``, ..."""
    return scene.split("_")[0]
