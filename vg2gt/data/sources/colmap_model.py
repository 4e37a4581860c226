"""COLMAP models with their images; optionally with sparse depth at the model's points."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Unpack

from vg2gt.data.base import DataError
from vg2gt.data.sources.files import FileSource, HoldoutOptions
from vg2gt.data.sources.index import PosedImage, SceneIndex, make_index
from vg2gt.data.sources.masks import FOLDER as MASKS
from vg2gt.data.sources.masks import find_masks
from vg2gt.data.sources.parsing import IMAGE_SUFFIXES, errors_name, existing_image, named_file, to_world
from vg2gt.data.sources.sparse_points import SparsePoints
from vg2gt.data.sources.undistortion import posed_image, size_on_disk
from vg2gt.io import colmap_images, colmap_pose, read_colmap
from vg2gt.io.colmap import Image, Reconstruction, colmap_files
from vg2gt.io.image_files import Size, read_color

log = logging.getLogger(__name__)

_MODELS = ("sparse", "colmap/sparse", ".")
_SCENES_IN_MEMORY = 16
_CLEARLY = 0.7  # the stored orientation is used if its colour difference is below this fraction of the upright one's


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
    index_version = 4
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
        model, model_folder = self._read_model(scene, folder)
        records = colmap_images(model)
        where = f"{model_folder} of scene {scene}"
        named = {i: named_file(folder / self.images, record.name, where) for i, record in enumerate(records)}
        with errors_name(scene):
            color = {i: found for i, path in named.items() if (found := existing_image(path)) is not None}
        if not color:
            names = f"the first is {records[0].name}, expected at {named[0]}" if records else "it names none"
            raise DataError(
                f"scene {scene}: none of the model's {len(records)} images is in {folder / self.images}; {names}. Copy "
                "them there, or set data.images to the name of their folder"
            )
        masks = find_masks(folder / MASKS, {i: records[i].name for i in color}, f"scene {scene}")
        poses = {i: to_world(colmap_pose(record)) for i, record in enumerate(records)}
        posed = {i: self._posed(scene, where, model, records[i], path, masks.get(i)) for i, path in color.items()}
        depth = None
        if self.has_depth:
            points = self._scene_points(scene, folder)
            depth = {i: model_folder for i in color if len(points.depth(i))}
        return make_index(scene, folder, color, depth, poses, {}, posed=posed)

    def read_depth(self, index: SceneIndex, row: int, size: Size) -> NDArray[np.float32]:
        """Returns depth at the pixels of the points that a view observes; the nearest point wins a pixel."""
        points, frame = self._scene_points(index.name, index.folder), index.frame_ids[row]
        extent = np.array((size[1], size[0]))
        pixels = np.floor(points.places(frame) * extent).astype(np.int64).clip(max=extent - 1)
        depth = np.full(size, np.inf, np.float32)
        np.minimum.at(depth, (pixels[:, 1], pixels[:, 0]), points.depth(frame))
        return np.where(np.isfinite(depth), depth, 0)

    def point_depths(self, scene: str, frame: int) -> NDArray[np.float32]:
        """Returns the positive z-depth ``[n]`` of all points that a frame observes, including likely outliers."""
        return self._scene_points(scene, self._folders[scene], sound=False).depth(frame)

    def _posed(
        self, scene: str, where: str, model: Reconstruction, record: Image, path: Path, mask: Path | None
    ) -> PosedImage:
        camera = record.camera
        expected = (camera.height, camera.width)
        size, upright = size_on_disk(path, scene, expected, where, partial(_is_stored, model, record, path))
        return posed_image(camera, expected, size, upright, mask, f"{where}, {record.name}")

    def _scene_points(self, scene: str, folder: Path, sound: bool = True) -> SparsePoints:
        if (scene, sound) not in self._points:
            if len(self._points) >= _SCENES_IN_MEMORY:
                self._points.clear()
            self._points[scene, sound] = SparsePoints(self._read_model(scene, folder)[0], sound)
        return self._points[scene, sound]

    def _read_model(self, scene: str, folder: Path) -> tuple[Reconstruction, Path]:
        models = models_of(folder)
        if not models:
            raise DataError(f"scene {scene} has no COLMAP model in {folder}: expected sparse/0 or sparse")
        if len(models) > 1:
            names = [str(place.relative_to(folder)) for place in models]
            message = "scene %s has %d COLMAP models: using %s, the largest, ignoring %s"
            log.warning(message, scene, len(models), names[0], ", ".join(names[1:]))
        with errors_name(scene):
            return read_colmap(models[0]), models[0]


def models_of(folder: Path) -> list[Path]:
    """Returns the models at the first location that has any; the one with the largest file of images comes first."""
    for name in _MODELS:
        place = folder / name
        if not place.is_dir() or (name == "." and not _has_images(place)):
            continue
        inside = sorted(path for path in place.iterdir() if path.name.isdigit()) if name != "." else []
        found = [path for path in (*inside, place) if colmap_files(path)]
        if found:
            return sorted(found, key=lambda model: -colmap_files(model)["images"].stat().st_size)
    return []


def model_folder_of(folder: Path) -> Path | None:
    """Returns the folder of a scene's largest model; None if there is none."""
    return next(iter(models_of(folder)), None)


def _has_images(folder: Path) -> bool:
    return any(path.suffix.lower() in IMAGE_SUFFIXES or path.name == "images" for path in folder.iterdir())


def _is_stored(model: Reconstruction, record: Image, path: Path) -> bool:
    """Returns whether the model's point colours match an image clearly better as stored than rotated upright."""
    camera, differences = record.camera, []
    features = [feature for feature in record.points2D if feature.point3D_id in model.points3D]
    if not features:
        return False
    expected = np.array([model.points3D[feature.point3D_id].color for feature in features], np.float64)
    places = np.array([feature.xy for feature in features]) / (camera.width, camera.height)
    for upright in (False, True):
        pixels = read_color(path, "", upright=upright)
        x, y = (places * pixels.shape[1::-1]).astype(np.int64).clip(0, np.array(pixels.shape[1::-1]) - 1).T
        differences.append(np.abs(pixels[y, x] - expected).mean())
    return bool(differences[0] < _CLEARLY * differences[1])
