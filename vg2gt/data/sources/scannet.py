"""ScanNet: exported to image files, or read from its ``.sens`` streams without exporting them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vg2gt.data.base import DataError
from vg2gt.data.sources.files import FileSource
from vg2gt.data.sources.index import SceneIndex, check_found, first_size, make_index
from vg2gt.data.sources.parsing import numbered, read_matrix, read_poses
from vg2gt.io.image_files import Size, read_color
from vg2gt.io.sens import decode_depth, read_span, scan_sens

INTRINSICS = "intrinsic/intrinsic_depth.txt"
"""A scan's intrinsics, those of its depth images."""


class ScanNet(FileSource):
    """Scans exported from ScanNet's ``.sens`` files; a scene is a scan such as ``scene0000_00``.

    ``color/N.jpg`` (1296x968), ``depth/N.png`` (640x480, millimetres, 0 = none), ``pose/N.txt`` (4x4 camera-to-world)
    and ``intrinsic/intrinsic_depth.txt`` (4x4). Numbers are not padded. Frames at which tracking was lost have a pose
    of -inf and are left out. Colour is resized to the depth images, which it is registered to, and the intrinsics are
    those of the depth images; extrinsics between the two cameras are the identity and not read.

    The arguments are those of ``FileSource``. ``root`` is ScanNet's folder, or its ``scans``, or a scan, or a list of
    such; a list of scenes may be the official ``scannetv2_train.txt``; the camera takes 30 frames per second.
    """

    scene_marks = ("color", "depth", "pose")
    layout = "sceneNNNN_NN/{color,depth,pose,intrinsic}, there or up to two folders deeper"

    def place(self, scene: str) -> str:
        """The room: ``scene0000`` of ``scene0000_00`` and ``scene0000_01``."""
        return room_of_scan(scene)

    def watched(self, scene: str, folder: Path) -> Sequence[Path | None]:
        """Also the intrinsics."""
        return folder, folder / INTRINSICS

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Lists a scan's files and reads its poses and intrinsics."""
        color, depth = numbered(folder / "color", scene), numbered(folder / "depth", scene)
        check_found(scene, folder, {"colour images": color, "depth images": depth})
        poses = read_poses(numbered(folder / "pose", scene, suffixes=(".txt",)), scene)
        intrinsics = read_matrix(folder / INTRINSICS, scene, ((4, 4),))[:3, :3]
        size = first_size(depth, scene)
        return make_index(scene, folder, color, depth, poses, intrinsics, size=size, depth_size=size)


class ScanNetSens(ScanNet):
    """Scans in ScanNet's raw ``.sens`` files; a scene is a file, its frames are numbered as in an export.

    Frames, depth and intrinsics are those of ``ScanNet``. Images are decoded where they lie, which the index says;
    nothing else of the file, which has gigabytes, is read.

    The arguments are those of ``ScanNet``; without ``index_cache``, every process reads the headers of all frames of a
    scan at first.
    """

    layout = "sceneNNNN_NN.sens, there or up to two folders deeper"

    def find(self, root: Path) -> Mapping[str, Path]:
        """``.sens`` files by their name."""
        found: dict[str, Path] = {}
        for path in sorted(path for pattern in ("*", "*/*", "*/*/*") for path in root.glob(pattern + ".sens")):
            if path.stem in found:
                raise DataError(f"two scans are called {path.stem}: {found[path.stem]} and {path}; remove one")
            found[path.stem] = path
        return found

    def watched(self, scene: str, folder: Path) -> Sequence[Path | None]:
        """The file."""
        return (folder,)

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Reads the headers of all frames."""
        stream, poses = scan_sens(folder, scene)
        files = dict.fromkeys(range(len(poses)), folder)
        index = make_index(
            scene, folder, files, files, dict(enumerate(poses)), stream.depth_intrinsics,
            color_size=stream.color_size, size=stream.depth_size, depth_size=stream.depth_size,
        )  # fmt: skip
        kept = list(index.frame_ids)
        coding = np.array([stream.depth_compression, stream.depth_scale])
        return replace(index, extra={"color": stream.color[kept], "depth": stream.depth[kept], "depth_coding": coding})

    def read_color(self, index: SceneIndex, row: int) -> NDArray[np.uint8]:
        """Decodes a colour image of the stream."""
        path, frame = index.color[row], index.frame_ids[row]
        content = read_span(path, index.name, index.extra["color"][row])
        return read_color(path, f"{index.name} (frame {frame})", index.color_size, content)

    def read_depth(self, index: SceneIndex, row: int, size: Size) -> NDArray[np.float32]:
        """Decodes a depth image of the stream."""
        path, frame = index.depth[row], index.frame_ids[row]
        content = read_span(path, index.name, index.extra["depth"][row])
        compression, scale = index.extra["depth_coding"].tolist()
        where = f"frame {frame} in {path} of scene {index.name}"
        return (decode_depth(content, int(compression), size, where) / scale).astype(np.float32)


def room_of_scan(scene: str) -> str:
    """What a scan shows: the same room was scanned several times, as ``scene0000_00``, ``scene0000_01``, ..."""
    return scene.split("_")[0]
