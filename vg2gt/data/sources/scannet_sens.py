"""ScanNet, read from its ``.sens`` files without exporting them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vg2gt.data.base import DataError
from vg2gt.data.sources.files import FileSource
from vg2gt.data.sources.index import SceneIndex, make_index
from vg2gt.data.sources.scannet import room_of_scan
from vg2gt.io.image_files import Size, read_color
from vg2gt.io.sens import decode_depth, read_span, scan_sens


class ScanNetSens(FileSource):
    """Scans in ScanNet's raw ``.sens`` files; a scene is a file, its frames are numbered as in an export.

    Frames, depth and intrinsics are those of ``ScanNet``. Images are decoded where they lie, which the index says;
    nothing else of the file, which has gigabytes, is read.

    Args:
        root: ScanNet's folder, or its ``scans``, or the folder of a scan, or a list of such.
        scenes: names of scans, or a text file with one a line (the official ``scannetv2_train.txt``); None: all.
        holdout: hold out every this many-th frame as an evaluation target; None: none.
        every: use every this many-th frame only (the camera takes 30 a second).
        index_cache: see ``FileSource``; without it, every process reads the headers of all frames of a scan at first.

    Raises:
        FileNotFoundError: if a root does not exist.
        DataError: if a root holds no ``.sens`` file.
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

    def place(self, scene: str) -> str:
        """The room: ``scene0000`` of ``scene0000_00`` and ``scene0000_01``."""
        return room_of_scan(scene)

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Reads the headers of all frames."""
        stream, poses = scan_sens(folder, scene)
        files = dict.fromkeys(range(len(poses)), folder)
        index = make_index(
            name=scene,
            folder=folder,
            color=files,
            depth=files,
            camera_to_world=dict(enumerate(poses)),
            intrinsics=stream.depth_intrinsics,
            size=stream.depth_size,
            color_size=stream.color_size,
            depth_size=stream.depth_size,
        )
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
