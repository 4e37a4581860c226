"""Captures with a ``transforms.json``, as nerfstudio, instant-ngp and many capture apps write it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Unpack

from vg2gt.data.base import DataError
from vg2gt.data.sources.files import FileSource, HoldoutOptions
from vg2gt.data.sources.index import SceneIndex, make_index
from vg2gt.data.sources.parsing import check_intrinsics, errors_name, named_file, positive, to_world
from vg2gt.data.sources.undistortion import Undistortion
from vg2gt.io import Lens, TransformsFrame, read_transforms
from vg2gt.io.image_files import Size, image_size

_FILE = "transforms.json"
_SCENES_IN_MEMORY = 64
_MODELS = (None, "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE")


class Nerfstudio(FileSource):
    """Scenes with a ``transforms.json`` (camera-to-world, OpenGL axes); the scale is arbitrary.

    Frames are numbered 0, 1, ... in the order of their file names, also where an image is absent (left out and
    counted). Distorted images are undistorted when they are read (``Undistortion``). Images of several sizes are
    resized to cover the median size and cropped.

    Args:
        root: a scene, a folder of scenes (one or two levels deep), or a list of such folders.
        depth: read the depth images that frames name as ``depth_file_path``; frames without are left out.
        depth_scale: stored depth units for one unit of the poses: 1000 for millimetres and metres.
        shared: see ``FileSource``.
    """

    layout = f"{_FILE}, there or up to two folders deeper"
    scene_marks = (_FILE,)
    names_are_paths = True
    index_options = ("has_depth",)
    is_metric = False

    def __init__(
        self,
        root: str | Sequence[str] | None,
        depth: bool = False,
        depth_scale: float = 1000.0,
        **shared: Unpack[HoldoutOptions],
    ) -> None:
        self.has_depth = depth
        self.depth_scale = positive("depth_scale", depth_scale, "stored units for one of the poses")
        self._frames: dict[str, list[TransformsFrame]] = {}
        self._last: tuple[Lens, Undistortion] | None = None
        super().__init__(root, **shared)

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Reads the file and the sizes of its images."""
        records = self._records(scene, folder)
        where = f"{folder / _FILE} of scene {scene}"
        with errors_name(scene):
            color = {i: _image_path(named_file(folder, record.file_path, where)) for i, record in enumerate(records)}
            color = {i: path for i, path in color.items() if path.is_file()}
            named = {i: record.depth_file_path for i, record in enumerate(records) if record.depth_file_path}
            depth = {i: named_file(folder, name, where) for i, name in named.items()}
        if not color:
            raise DataError(f"scene {scene}: none of the {len(records)} images of {folder / _FILE} exists")
        sizes = {i: image_size(path, scene) for i, path in color.items()}
        poses = {i: to_world(np.asarray(record.world_to_camera, np.float64)) for i, record in enumerate(records)}
        intrinsics = {i: self._intrinsics(scene, records[i], sizes[i], path) for i, path in color.items()}
        return make_index(scene, folder, color, depth if self.has_depth else None, poses, intrinsics, color_size=sizes)

    def read_color(self, index: SceneIndex, row: int) -> NDArray[np.uint8]:
        """Decodes a colour image and undistorts it."""
        pixels = super().read_color(index, row)
        size = (pixels.shape[0], pixels.shape[1])
        undistortion = self._undistortion(index.name, self._record(index, row).lens, size, index.color[row])
        return undistortion.color(pixels) if undistortion else pixels

    def read_depth(self, index: SceneIndex, row: int, size: Size) -> NDArray[np.float32]:
        """Decodes an integer depth image and undistorts it like its colour image."""
        depth = super().read_depth(index, row, size)
        undistortion = self._undistortion(index.name, self._record(index, row).lens, size, index.color[row])
        return undistortion.depth(depth) if undistortion else depth

    def _records(self, scene: str, folder: Path) -> list[TransformsFrame]:
        if scene not in self._frames:
            if len(self._frames) >= _SCENES_IN_MEMORY:
                self._frames.clear()
            with errors_name(scene):
                frames = read_transforms(folder / _FILE).frames
            self._frames[scene] = sorted(frames, key=lambda frame: frame.file_path)
        return self._frames[scene]

    def _record(self, index: SceneIndex, row: int) -> TransformsFrame:
        return self._records(index.name, index.folder)[index.frame_ids[row]]

    def _intrinsics(self, scene: str, record: TransformsFrame, size: Size, path: Path) -> NDArray[np.float64]:
        undistortion = self._undistortion(scene, record.lens, size, path)
        matrix = undistortion.intrinsics if undistortion else record.lens.intrinsics(size)
        return np.asarray(matrix, np.float64)

    def _undistortion(self, scene: str, lens: Lens, size: Size, path: Path) -> Undistortion | None:
        """How to undistort an image of a lens; None where there is nothing to do."""
        where = f"{_FILE} of scene {scene}, for {path}"
        if (lens.height or size[0], lens.width or size[1]) != size:
            raise DataError(f"{where} says {lens.width}x{lens.height} pixels, but the image is {size[1]}x{size[0]}")
        if lens.camera_model not in _MODELS:
            names = ", ".join(name for name in _MODELS if name)
            raise DataError(f"{where} has a camera of model {lens.camera_model}; read are: {names}")
        matrix = check_intrinsics(np.asarray(lens.intrinsics(size), np.float64), where)
        if not lens.is_distorted:
            return None
        if self._last is None or self._last[0] != lens or self._last[1].size != size:
            try:
                undistortion = Undistortion(matrix, lens.distortion, "FISHEYE" in (lens.camera_model or ""), size)
            except ValueError as error:
                raise DataError(f"{where}: {error}") from error
            self._last = lens, undistortion
        return self._last[1]


def _image_path(path: Path) -> Path:
    """The file, which some writers name without its suffix."""
    return path if path.is_file() or path.suffix else Path(f"{path}.png")
