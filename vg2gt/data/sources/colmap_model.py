"""COLMAP models with their images; optionally with sparse depth at the model's points."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Unpack

from vg2gt.data.base import DataError
from vg2gt.data.sources.files import FileSource, HoldoutOptions
from vg2gt.data.sources.index import PosedImage, SceneIndex, make_index
from vg2gt.data.sources.masks import FOLDER as MASKS
from vg2gt.data.sources.masks import find_masks
from vg2gt.data.sources.parsing import IMAGE_SUFFIXES, errors_name, existing_image, named_file
from vg2gt.data.sources.sparse_points import ObservedPoints, SparsePoints
from vg2gt.data.sources.undistortion import posed_image, size_on_disk
from vg2gt.io import colmap_images, colmap_pose, read_colmap
from vg2gt.io.cameras_json import invert_pose
from vg2gt.io.colmap import colmap_files, count_images
from vg2gt.io.image_files import Size

log = logging.getLogger(__name__)

_MODELS = ("sparse", "colmap/sparse", ".")
_SCENES_IN_MEMORY = 16


class COLMAP(FileSource):
    """Scenes with ``images/`` and a text or binary COLMAP model in ``sparse/0`` or ``sparse``, of arbitrary scale.

    Frames are numbered 0, 1, ... in natural order of the model's image names. Missing images keep their number, but
    are left out and counted. Images are undistorted when they are read; all camera models except EQUIRECTANGULAR are
    supported. Images of different sizes are resized to cover the median size and cropped. Pixel weights come from
    alpha and ``masks/``.

    Args:
        root: a scene, a folder of scenes (one or two levels deep), or a list of such folders.
        images: name of the image folder. Images of another size than their camera's, such as ``images_4``, are
            treated as resized: the intrinsics are scaled accordingly.
        depth: ``points``: depth of the model's points in the views that observe them, without likely outliers
            (``SparsePoints``); None: no depth.
        shared: see ``FileSource``.
    """

    layout = "a COLMAP model in sparse/0 or sparse and its images/, there or up to two folders deeper"
    names_are_paths = True
    index_version = 6
    index_options = ("images", "has_depth")
    sparse_depth = True
    reads_masks = True
    is_metric = False
    dense_depth = False

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
        self._points: dict[tuple[str, bool], SparsePoints] = {}
        super().__init__(root, **shared)

    def is_scene(self, folder: Path) -> bool:
        """Returns whether a folder contains a COLMAP model."""
        return model_folder_of(folder) is not None

    def watched(self, scene: str, folder: Path) -> Sequence[Path | None]:
        """Returns the scene's folder and the model's folder."""
        return folder, model_folder_of(folder)

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Reads the model and the sizes of its images."""
        model_folder = largest_of(models_of(folder), f" of scene {scene}")
        where = f"{model_folder} of scene {scene}"
        with errors_name(scene):
            records = colmap_images(read_colmap(model_folder))
            named = {i: named_file(folder / self.images, record.name, where) for i, record in enumerate(records)}
            there = {i: found for i, path in named.items() if (found := existing_image(path)) is not None}
            color = self.sound(there)
        if not color:
            names = f"the first is {records[0].name}, expected at {named[0]}" if records else "it names none"
            raise DataError(
                f"scene {scene}: none of the model's {len(records)} images is in {folder / self.images}; {names}. Copy "
                "them there, or set data.images to the name of their folder"
            )
        masks = find_masks(folder / MASKS, {i: records[i].name for i in color}, color, f"scene {scene}", {})
        damaged = there.keys() - color.keys()  # their names have been said
        poses = {i: invert_pose(colmap_pose(record)) for i, record in enumerate(records) if i not in damaged}
        posed: dict[int, PosedImage] = {}
        for i, path in color.items():
            camera = records[i].camera
            expected = (camera.height, camera.width)
            size, upright = size_on_disk(path, scene, expected, where)
            posed[i] = posed_image(camera, expected, size, upright, masks.get(i), f"{where}, {records[i].name}")
        depth = None
        if self.has_depth:
            points = self._scene_points(scene, folder)
            depth = {i: model_folder for i in color if len(points.of(i).depth)}
        return make_index(scene, folder, color, depth, poses, {}, posed=posed)

    def read_depth(self, index: SceneIndex, row: int, size: Size) -> NDArray[np.float32]:
        """Returns depth at the pixels of the points that a view observes; the nearest point wins a pixel."""
        points = self._scene_points(index.name, index.folder).of(index.frame_ids[row])
        extent = np.array((size[1], size[0]))
        pixels = np.floor(points.places * extent).astype(np.int64).clip(max=extent - 1)
        depth = np.full(size, np.inf, np.float32)
        np.minimum.at(depth, (pixels[:, 1], pixels[:, 0]), points.depth)
        return np.where(np.isfinite(depth), depth, 0)

    def point_depths(self, scene: str, frame: int) -> NDArray[np.float32]:
        """Returns the positive z-depth ``[n]`` of all points that a frame observes, including likely outliers."""
        return self._scene_points(scene, self._folders[scene], sound=False).of(frame).depth

    def sound_points(self, scene: str, frame: int) -> ObservedPoints:
        """Returns the points that a frame observes, without likely outliers."""
        return self._scene_points(scene, self._folders[scene]).of(frame)

    def _scene_points(self, scene: str, folder: Path, sound: bool = True) -> SparsePoints:
        if (scene, sound) not in self._points:
            if len(self._points) >= _SCENES_IN_MEMORY:
                self._points.clear()
            with errors_name(scene):
                self._points[scene, sound] = SparsePoints(read_colmap(models_of(folder)[0]), sound)
        return self._points[scene, sound]


def models_of(folder: Path) -> list[Path]:
    """Returns the models at the first location that has any; the one with most images comes first."""
    for name in _MODELS:
        place = folder / name
        if not place.is_dir() or (name == "." and not _has_images(place)):
            continue
        if found := models_in(place, split=name != "."):
            return found
    return []


def models_in(place: Path, split: bool = True) -> list[Path]:
    """Returns the models in a folder and, if ``split``, in its subfolders ``0``, ``1``, ...; most images first."""
    inside = sorted(path for path in place.iterdir() if path.name.isdigit()) if split else []
    found = [path for path in (*inside, place) if colmap_files(path)]
    return sorted(found, key=lambda model: (-count_images(model), -colmap_files(model)["images"].stat().st_size))


def largest_of(models: Sequence[Path], where: str = "") -> Path:
    """Returns the first of the models; the others are named in a warning."""
    if others := models[1:]:
        log.warning("%s%s is its largest COLMAP model; ignored: %s", models[0], where, ", ".join(map(str, others)))
    return models[0]


def model_folder_of(folder: Path) -> Path | None:
    """Returns the folder of a scene's largest model; None if there is none."""
    return next(iter(models_of(folder)), None)


def _has_images(folder: Path) -> bool:
    return any(path.suffix.lower() in IMAGE_SUFFIXES or path.name == "images" for path in folder.iterdir())
