"""Captures with a ``transforms.json``, as written by nerfstudio, instant-ngp, Blender scripts and capture apps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Unpack

from vg2gt.data.base import DataError
from vg2gt.data.sources.files import FileSource, HoldoutOptions
from vg2gt.data.sources.index import PosedImage, SceneIndex, make_index
from vg2gt.data.sources.masks import FOLDER as MASKS
from vg2gt.data.sources.masks import find_masks
from vg2gt.data.sources.parsing import check_intrinsics, errors_name, existing_image, named_file
from vg2gt.data.sources.undistortion import posed_image, size_on_disk
from vg2gt.io import Lens, TransformsFrame, read_transforms
from vg2gt.io.cameras_json import invert_pose
from vg2gt.io.colmap import PIXEL_CENTER, Camera, require_pycolmap
from vg2gt.io.files import by_number
from vg2gt.io.image_files import Size, image_size

FILE = "transforms.json"
BLENDER = ("transforms_train.json", "transforms_val.json", "transforms_test.json")
_MODELS = (None, "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE")


class Nerfstudio(FileSource):
    """Scenes with a ``transforms.json`` (camera-to-world, OpenGL axes), of arbitrary scale.

    Also reads Blender's synthetic sets with ``transforms_train.json``, ``_val`` and ``_test``. Their test frames are
    held out, whatever ``holdout`` is.

    Frames are numbered 0, 1, ... in natural order of their file names. Missing images keep their number, but are left
    out and counted. Distorted images are undistorted when they are read (``Undistortion``). Images of different sizes
    are resized to cover the median size and cropped. Pixel weights come from alpha, ``mask_path`` and ``masks/``.

    Args:
        root: a scene, a folder of scenes (one or two levels deep), or a list of such folders.
        depth: read the depth images given by ``depth_file_path``; frames without one are left out.
        depth_scale: stored depth units per unit of the poses: 1000 for depth in millimetres and poses in metres.
        shared: see ``FileSource``.
    """

    layout = f"{FILE}, or Blender's {', '.join(BLENDER)}, there or up to two folders deeper"
    names_are_paths = True
    index_version = 6
    index_options = ("has_depth",)
    reads_masks = True
    is_metric = False

    def __init__(
        self,
        root: str | Sequence[str] | None,
        depth: bool = False,
        depth_scale: float = 1000.0,
        **shared: Unpack[HoldoutOptions],
    ) -> None:
        self.has_depth = depth
        self.depth_scale = depth_scale
        super().__init__(root, **shared)

    def is_scene(self, folder: Path) -> bool:
        """Returns whether a folder contains one of the files."""
        return bool(transforms_files(folder))

    def held_out(self, scene: str) -> Sequence[int]:
        """Returns Blender's test frames if there are any, otherwise every ``holdout``-th frame."""
        index = self.scene_index(scene)
        tests = index.extra.get("test", np.zeros(len(index.frame_ids), bool))
        return [frame for frame in self.frames(scene) if tests[index.row(frame)]] or super().held_out(scene)

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Reads the transforms and the sizes of the images."""
        records, first_test = _records(scene, folder)
        where = f"{transforms_files(folder)[0]} of scene {scene}"
        with errors_name(scene):
            named = _named_files(folder, records, "file_path", where)
            there = {i: found for i, path in named.items() if (found := existing_image(path)) is not None}
            color = self.sound(there)
            depth = _named_files(folder, records, "depth_file_path", where) if self.has_depth else {}
            depth = {i: path for i, path in depth.items() if path.is_file()}
            masks = _named_files(folder, records, "mask_path", where)
        counts = Counter(path.name for path in color.values())
        names = {i: path.name if counts[path.name] == 1 else records[i].file_path for i, path in color.items()}
        masks = find_masks(folder / MASKS, names, color, f"scene {scene}", masks)
        if not color:
            tried = f"; tried {named[0]} and other endings" if named else ""
            raise DataError(f"scene {scene}: none of the {len(records)} images of {where} exists{tried}")
        damaged = there.keys() - color.keys()  # their names have been said
        sound = {i: record for i, record in enumerate(records) if i not in damaged}
        poses = {i: invert_pose(np.asarray(record.world_to_camera, np.float64)) for i, record in sound.items()}
        posed = {i: _posed(scene, where, records[i].lens, path, masks.get(i)) for i, path in color.items()}
        index = make_index(scene, folder, color, depth if self.has_depth else None, poses, {}, posed=posed)
        return replace(index, extra={**index.extra, "test": np.array(index.frame_ids) >= first_test})


def transforms_files(folder: Path) -> list[Path]:
    """Returns the ``transforms.json`` of a folder, or Blender's files."""
    if (folder / FILE).is_file():
        return [folder / FILE]
    return [folder / name for name in BLENDER if (folder / name).is_file()]


def _records(scene: str, folder: Path) -> tuple[list[TransformsFrame], int]:
    """Returns the frames in order, and the number of the first Blender test frame."""
    frames, first_test = [], 0
    for path in transforms_files(folder):
        with errors_name(scene):
            own = read_transforms(path).frames
        first_test = len(frames) if path.name == BLENDER[-1] else len(frames) + len(own)
        frames += sorted(own, key=lambda frame: by_number(frame.file_path))
    return frames, first_test


def _named_files(folder: Path, records: Sequence[TransformsFrame], field: str, where: str) -> dict[int, Path]:
    named = {i: getattr(record, field) for i, record in enumerate(records) if getattr(record, field)}
    return {i: named_file(folder, name.replace("\\", "/"), where) for i, name in named.items()}


def _posed(scene: str, where: str, lens: Lens, path: Path, mask: Path | None) -> PosedImage:
    """Makes the index entry of an image, which may be smaller than the file says."""
    where = f"{where}, for {path}"
    if (lens.camera_model or "PINHOLE").upper() not in _MODELS:
        names = ", ".join(name for name in _MODELS if name)
        raise DataError(f"{where} has the unsupported camera model {lens.camera_model}; supported: {names}")
    if lens.width and lens.height:
        expected = (lens.height, lens.width)
        size, upright = size_on_disk(path, scene, expected, where)
    else:
        size, upright = image_size(path, scene, upright=True), True
        expected = size
    matrix = check_intrinsics(np.asarray(lens.intrinsics(expected), np.float64), where)
    camera = _distorted(lens, matrix, expected, where) if lens.is_distorted else matrix
    return posed_image(camera, expected, size, upright, mask, where)


def _distorted(lens: Lens, matrix: NDArray[np.float64], size: Size, where: str) -> Camera:
    """Returns the lens as a COLMAP camera: OPENCV_FISHEYE, or FULL_OPENCV, which covers all but a radial k4."""
    require_pycolmap(f"undistorting the images of {where}")
    import pycolmap  # pyright: ignore[reportMissingImports]

    k = lens.distortion
    fisheye = "FISHEYE" in (lens.camera_model or "").upper()
    if unread := [name for name in ("k4", "k5", "k6")[fisheye:] if k.get(name)]:
        remedy = "" if fisheye else "set camera_model or is_fisheye if it is a fisheye, which may have a k4, otherwise "
        raise DataError(
            f"{where} has a distortion {', '.join(unread)}, which is not supported: {remedy}undistort the images "
            "before, or calibrate with k1, k2, k3, p1 and p2 only"
        )
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    coefficients = [k.get(name, 0.0) for name in names] + ([] if fisheye else [0.0] * 3)
    center = matrix[:2, 2] + PIXEL_CENTER
    return pycolmap.Camera(
        model="OPENCV_FISHEYE" if fisheye else "FULL_OPENCV",
        width=size[1],
        height=size[0],
        params=[matrix[0, 0], matrix[1, 1], *center, *coefficients],
    )
