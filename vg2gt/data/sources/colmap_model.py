"""COLMAP models with their undistorted images; depth, if wanted, at the model's own points."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from typing_extensions import Unpack

from vg2gt.data.base import DataError
from vg2gt.data.sources.files import FileSource, HoldoutOptions
from vg2gt.data.sources.index import SceneIndex, make_index
from vg2gt.data.sources.parsing import errors_name, named_file, to_world
from vg2gt.data.sources.sparse_points import SparsePoints, in_order
from vg2gt.geometry.cameras import resize_intrinsics
from vg2gt.io import ColmapImage, ColmapModel, colmap_intrinsics, colmap_pose, read_colmap
from vg2gt.io.image_files import Size, image_size

_MODELS = ("sparse/0", "sparse")
_FILES = ("cameras.bin", "cameras.txt")
_SCENES_IN_MEMORY = 16


class COLMAP(FileSource):
    """Scenes of ``images/`` with a COLMAP model in ``sparse/0`` or ``sparse``, text or binary; the scale is arbitrary.

    Frames are numbered 0, 1, ... in the order of the model's image names, also where an image is absent (left out and
    counted). Only undistorted cameras (PINHOLE, SIMPLE_PINHOLE) are read. Images of several sizes are resized to cover
    the median size and cropped.

    Args:
        root: a scene, a folder of scenes (one or two levels deep), or a list of such folders.
        images: name of the image folder. Images of another size than the cameras' are taken for resized ones, such as
            ``images_4``, and the intrinsics are resized with them.
        depth: ``points``: depth at the model's points in the views that saw them, without likely outliers
            (``SparsePoints``); null: none.
        shared: see ``FileSource``.
    """

    layout = "a COLMAP model in sparse/0 or sparse and its undistorted images/, there or up to two folders deeper"
    names_are_paths = True
    index_version = 3
    index_options = ("images", "has_depth")
    sparse_depth = True
    is_metric = False

    def __init__(
        self,
        root: str | Sequence[str] | None,
        images: str = "images",
        depth: str | None = None,
        **shared: Unpack[HoldoutOptions],
    ) -> None:
        if depth not in (None, "points"):
            raise ValueError(f"depth must be points (at the model's points) or null (none), got {depth!r}")
        self.images = images
        self.has_depth = depth is not None
        self._points: dict[str, SparsePoints] = {}
        self._all_points: dict[str, SparsePoints] = {}
        super().__init__(root, **shared)

    def is_scene(self, folder: Path) -> bool:
        """Whether it holds a model."""
        return model_folder_of(folder) is not None

    def watched(self, scene: str, folder: Path) -> Sequence[Path | None]:
        """Also the model's folder."""
        return folder, model_folder_of(folder)

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Reads the model and the sizes of its images."""
        model, model_folder = self._read_model(scene, folder)
        refuse_distorted(model, f"{model_folder} (scene {scene})")
        records = in_order(model)
        where = f"{model_folder} of scene {scene}"
        named = {i: named_file(folder / self.images, record.name, where) for i, record in enumerate(records)}
        with errors_name(scene):
            color = {i: path for i, path in named.items() if path.is_file()}
        if not color:
            names = f"the first is {records[0].name}, expected at {named[0]}" if records else "it names none"
            raise DataError(
                f"scene {scene}: none of the model's {len(records)} images is in {folder / self.images}; {names}. Copy "
                "them there, or name their folder by data.images="
            )
        sizes = {i: image_size(path, scene) for i, path in color.items()}
        poses = {i: to_world(colmap_pose(record)) for i, record in enumerate(records)}
        intrinsics = {i: image_intrinsics(model, records[i], sizes[i], path) for i, path in color.items()}
        depth = None
        if self.has_depth:
            points = self._scene_points(scene, folder)
            depth = {i: model_folder for i in color if len(points.depth(i))}
        return make_index(scene, folder, color, depth, poses, intrinsics, color_size=sizes)

    def read_depth(self, index: SceneIndex, row: int, size: Size) -> NDArray[np.float32]:
        """Depth of the points a view saw, at the pixels where it saw them; the nearest wins a pixel."""
        points, frame = self._scene_points(index.name, index.folder), index.frame_ids[row]
        extent = np.array((size[1], size[0]))
        pixels = np.floor(points.places(frame) * extent).astype(np.int64).clip(max=extent - 1)
        depth = np.full(size, np.inf, np.float32)
        np.minimum.at(depth, (pixels[:, 1], pixels[:, 0]), points.depth(frame))
        return np.where(np.isfinite(depth), depth, 0)

    def point_depths(self, scene: str, frame: int) -> NDArray[np.float32]:
        """``[n]`` positive z-depth of all points that a frame's image saw, however many others did."""
        if scene not in self._all_points:
            self._all_points = {scene: SparsePoints(self._read_model(scene, self._folders[scene])[0], sound=False)}
        return self._all_points[scene].depth(frame)

    def _scene_points(self, scene: str, folder: Path) -> SparsePoints:
        if scene not in self._points:
            if len(self._points) >= _SCENES_IN_MEMORY:
                self._points.clear()
            self._points[scene] = SparsePoints(self._read_model(scene, folder)[0])
        return self._points[scene]

    def _read_model(self, scene: str, folder: Path) -> tuple[ColmapModel, Path]:
        model_folder = model_folder_of(folder)
        if model_folder is None:
            raise DataError(f"scene {scene} has no COLMAP model in {folder}: expected {' or '.join(_MODELS)}")
        with errors_name(scene):
            return read_colmap(model_folder), model_folder


def model_folder_of(folder: Path) -> Path | None:
    """The folder of a scene's model, if it has one."""
    inside = [folder / name for name in _MODELS]
    return next((place for place in inside if any((place / name).is_file() for name in _FILES)), None)


def refuse_distorted(model: ColmapModel, where: str) -> None:
    """Refuses a model of distorted images.

    Raises:
        DataError: naming the camera models found, and the command that undistorts.
    """
    distorted = sorted({camera.model for camera in model.cameras.values() if not camera.is_pinhole})
    if distorted:
        raise DataError(
            f"the cameras in {where} are {', '.join(distorted)}; only undistorted ones (PINHOLE, SIMPLE_PINHOLE) are "
            "read. Undistort: colmap image_undistorter --image_path IMAGES --input_path MODEL --output_path SCENE"
        )


def image_intrinsics(model: ColmapModel, record: ColmapImage, size: Size, path: Path) -> NDArray[np.float64]:
    """Intrinsics ``[3, 3]`` of an image as it is on disk, which may be a reduced one.

    Args:
        model: the model.
        record: the image's record in it.
        size: the image's ``(height, width)`` on disk.
        path: the image, for the message.

    Raises:
        DataError: if the image has another shape than its camera.
    """
    camera = model.cameras[record.camera_id]
    scale = (size[1] / camera.width, size[0] / camera.height)
    # Sizes are whole pixels, so that both directions of a reduced image may be off by one.
    if abs(scale[0] / scale[1] - 1) > 2 / min(size):
        raise DataError(
            f"{path} is {size[1]}x{size[0]} pixels, but its camera in the model {camera.width}x{camera.height}: it is "
            "not the image the model was made of, nor a reduced one"
        )
    return resize_intrinsics(torch.from_numpy(colmap_intrinsics(camera)), *scale).numpy()
