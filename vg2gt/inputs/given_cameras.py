"""Pictures with cameras from files next to them: cameras.json, transforms.json, a COLMAP model, a list of poses."""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from vg2gt.data.base import DataError, Frames
from vg2gt.data.sources.colmap_model import COLMAP, model_folder_of
from vg2gt.data.sources.files import FileSource
from vg2gt.data.sources.nerfstudio import Nerfstudio, transforms_files
from vg2gt.data.sources.phone import app_of
from vg2gt.data.sources.rgbd import RGBDFolder
from vg2gt.data.sources.undistortion import size_on_disk, undistortion_of
from vg2gt.geometry.cameras import resize_intrinsics
from vg2gt.inputs.camera_files import cameras_of_json
from vg2gt.inputs.damaged import read_each
from vg2gt.inputs.distinct import with_unique_names
from vg2gt.inputs.folders import image_files, image_folders
from vg2gt.inputs.foreign import camera_files_in, foreign_cameras
from vg2gt.inputs.pictures import (
    UNKNOWN_LENS,
    ImagesLike,
    Picture,
    as_items,
    evenly,
    existing_path,
    frame_of,
    mask_for,
    shrunk,
)
from vg2gt.inputs.recordings import recording_pictures
from vg2gt.io.cameras_json import NamedCamera, Photo
from vg2gt.io.errors import FormatError, some
from vg2gt.io.files import composed, read_json
from vg2gt.io.image_files import is_damaged, read_color
from vg2gt.io.nerfstudio import read_transforms
from vg2gt.io.photogrammetry import is_camera_file
from vg2gt.io.record3d import R3D

log = logging.getLogger(__name__)

SFM_STATE = "sfm.json"
"""File in a folder of structure from motion that identifies and names its photographs."""
_CAMERAS, _TRANSFORMS = "cameras.json", "transforms.json"
LAYOUTS = (
    f"{_CAMERAS}, {_TRANSFORMS}, a COLMAP model in sparse/0, cameras of Metashape (.xml), RealityScan (.csv), Bundler "
    "(bundle.out) or VisualSFM (.nvm), or poses.txt with K.txt"
)


def given_pictures(images: ImagesLike, max_images: int | None = None, depth: bool = False) -> list[Picture] | None:
    """Lists the pictures whose cameras are in files next to them.

    The search order is ``cameras.json``, ``transforms.json`` (or Blender's ``transforms_train.json``), a COLMAP model,
    a recording with poses (with or without depth), a file of Metashape, RealityScan, Bundler or VisualSFM. The search
    covers the folder of the images, the folder above it, and ``dense/`` of a COLMAP workspace whose images are only
    there.

    Args:
        images: a folder, image files, an ``.r3d`` file, or a sequence of these.
        max_images: maximum number of pictures, evenly spread; None: all.
        depth: require depth too, and ignore cameras without it.

    Returns:
        The pictures in order, with unique names; None if any input has no cameras.

    Raises:
        FileNotFoundError: if a path does not exist.
        ImportError: if pycolmap is needed and not installed.
        ValueError: if a file of cameras is damaged, or belongs to other images.
    """
    items = as_items(images)
    if not all(isinstance(item, (str, Path)) for item in items):
        return None
    paths = [existing_path(item) for item in items]
    found: list[Picture] = []
    for folder, files in _by_folder(paths).items():
        own = _given(folder, depth)
        if own is None:
            return None
        found += own if files is None else _only(own, files, folder)
    return with_unique_names(evenly(found, max_images))


def _by_folder(paths: Sequence[Path]) -> dict[Path, list[Path] | None]:
    """Groups inputs by folder: a folder or recording as a whole (None), single images by their folder."""
    groups: dict[Path, list[Path] | None] = {}
    for path in paths:
        if path.is_dir() or app_of(path) or is_camera_file(path):
            groups[path] = None
        elif (files := groups.setdefault(path.parent, [])) is not None:
            files.append(path)
    return groups


def _only(pictures: list[Picture], files: list[Path], folder: Path) -> list[Picture]:
    """Returns the pictures of the named files, in the order of the files."""
    by_path = {picture.path.resolve(): picture for picture in pictures if picture.path is not None}
    found = [by_path[file.resolve()] for file in dict.fromkeys(files) if file.resolve() in by_path]
    _name_left_out([file.name for file in files if file.resolve() not in by_path], f"the folder {folder}")
    if not found:
        raise DataError(f"the cameras in {folder} do not match {files[0].name}")
    return found


def _given(folder: Path, depth: bool) -> list[Picture] | None:
    """Returns the pictures of a folder or recording with the cameras in there, or else one folder up."""
    if is_camera_file(folder):
        return None if depth else _of_camera_file(folder)
    inside = image_folders(folder) if folder.is_dir() else []
    places = [(folder, inside[0].name if inside else ".")]
    if not inside and (folder / "dense" / "images").is_dir():  # a COLMAP workspace without its distorted originals
        places.insert(0, (folder / "dense", "images"))
    if folder.is_dir():
        places.append((folder.resolve().parent, folder.resolve().name))
    for place, images in places:
        above = place == folder.resolve().parent and place != folder
        if above and not _may_be_of(place, folder.resolve()):
            continue
        try:
            pictures, others = _at(place, images, depth, above)
        except DataError as error:
            if not above:
                raise
            log.warning("cannot use the camera files in the folder above the images: %s", error)
            continue
        if pictures is not None and above:  # the cameras may be those of other photographs
            pictures = [each for each in pictures if each.path and _is_in(each.path, folder.resolve())] or None
        if pictures is not None:
            pictures = _with_titles(pictures, place / SFM_STATE)
            _name_missing(pictures, place / images, others)
            return pictures
    return None


def _at(place: Path, images: str, depth: bool, above: bool) -> tuple[list[Picture] | None, set[Path]]:
    """Returns the pictures with the cameras in a folder, and further files that belong to these, such as depth."""
    if not depth and (place / _CAMERAS).is_file():
        pictures = _from_cameras_json(place / _CAMERAS, place / images)
        if pictures is not None:
            return pictures, set()
    source = _source(place, images, depth)
    if source is None or (above and isinstance(source, RGBDFolder) and len(source.scenes) > 1):
        return (None if depth else _from_programs(place, place / images, above)), set()
    pictures = recording_pictures(source, with_tests=above)  # of ``test/`` if that is asked for
    index = source.scene_index(source.scenes[0])
    return pictures, {file.resolve() for file in (*index.color, *index.depth)}


def _with_titles(pictures: list[Picture], state: Path) -> list[Picture]:
    """Returns pictures found by structure from motion with the names of the photographs instead of their numbers."""
    try:
        titles = read_json(state)["images"] if state.is_file() else {}
        return [replace(each, name=str(titles.get(f"{each.name}.jpg", each.name))) for each in pictures]
    except (FormatError, KeyError, AttributeError):  # a damaged file of names
        return pictures


def _may_be_of(place: Path, folder: Path) -> bool:
    """Returns whether cameras in ``place`` can be those of a folder in it: not if it has other folders of images."""
    known = [each.resolve() for each in image_folders(place)]
    return not known or folder in known


def _is_in(path: Path, folder: Path) -> bool:
    """Returns whether a file, or the link to it, is in a folder or in the one that the folder is a reduced copy of."""
    parents = {*path.absolute().parents, *path.resolve().parents}
    original = folder.with_name(re.sub(r"_\d+$", "", folder.name))
    return folder in parents or original in parents


def _source(folder: Path, images: str, depth: bool) -> FileSource | None:
    """Returns the recording in a folder, with depth if needed; None for plain photographs."""
    if files := transforms_files(folder):
        with_depth = depth and any(frame.depth_file_path for frame in read_transforms(files[0]).frames)
        if with_depth or not depth:
            return Nerfstudio(str(folder), depth=with_depth)
    if not depth and model_folder_of(folder) is not None:
        return COLMAP(str(folder), images=images)
    has_depth = (folder / "depth").is_dir() or any(folder.glob("frame-*.color.*"))
    poses = not depth and any((folder / name).exists() for name in ("poses.txt", "pose", "poses"))
    if app_of(folder) is not None or any(folder.glob(f"*{R3D}")):
        has_depth = depth  # otherwise colour keeps its full size: a phone's depth is coarse
    elif not (has_depth or poses):
        return None
    return RGBDFolder(str(folder), holdout=None, depth=has_depth)


def _name_missing(pictures: list[Picture], folder: Path, others: set[Path]) -> None:
    """Warns about images of a folder, except ``others``, that have no camera."""
    known = {picture.path.resolve() for picture in pictures if picture.path is not None}
    try:
        files = image_files(folder)
    except (ValueError, OSError):  # the pictures are elsewhere, such as in an archive
        return
    if any(file.resolve() in known for file in files):
        missing = [file for file in files if file.resolve() not in known | others and not is_damaged(file)]
        _name_left_out([str(file.relative_to(folder)) for file in missing], pictures[0].source)


def _name_left_out(names: Sequence[str], where: str) -> None:
    if names:
        log.warning("%s has no cameras for %d images, which are left out: %s", where, len(names), some(names))


def _unique(named: Sequence[tuple[str, NamedCamera]]) -> dict[str, NamedCamera]:
    """Returns the cameras by name, without names of several cameras, such as photos of two folders."""
    counts = Counter(name for name, _ in {(name, id(camera)) for name, camera in named})
    return {name: camera for name, camera in named if counts[name] == 1}


def _from_cameras_json(path: Path, folder: Path) -> list[Picture] | None:
    """Returns pictures of a folder with cameras from ``cameras.json``, matched by file name or stem.

    Returns:
        None if the cameras are of undistorted images and the folder has the original photographs.

    Raises:
        ValueError: if the file names none of the images.
    """
    named = cameras_of_json(path)
    cameras = _unique([(composed(Path(camera.name).name), camera) for camera in named])
    cameras |= _unique([(composed(camera.photo.name), camera) for camera in named if camera.photo is not None])
    by_stem = _unique([(Path(name).stem, camera) for name, camera in cameras.items()])
    files = image_files(folder)
    names = [composed(file.name) for file in files]
    stems = [by_stem.get(Path(name).stem) or by_stem.get(name) for name in names]
    found = [(file, cameras.get(name) or stem) for file, name, stem in zip(files, names, stems, strict=True)]
    known = [(file, camera) for file, camera in found if camera is not None]
    if not known:
        raise DataError(f"{path} names none of the {len(files)} images in {folder}, such as {files[0].name}")
    if any(
        camera.photo and camera.photo.lens == UNKNOWN_LENS and composed(camera.photo.name) == composed(file.name)
        for file, camera in known
    ):
        log.warning("%s describes undistorted images and is ignored for the photos in %s", path, folder)
        return None
    with_cameras = dict(known)
    return read_each(with_cameras, lambda file: _photo(file, with_cameras[file], path))


def _of_camera_file(path: Path) -> list[Picture]:
    """Returns the pictures that a file of another program names, in its folder or one folder up."""
    for place in (path.parent, path.resolve().parent.parent):
        try:
            files = image_files(place)
        except ValueError:
            continue
        if found := foreign_cameras(path, files):
            return [_photo(file, camera, path, as_stored=True) for file, camera in found]
    raise DataError(f"{path} names no image next to it: put it into the folder of its images, or one folder up")


def _from_programs(place: Path, folder: Path, above: bool) -> list[Picture] | None:
    """Returns pictures of a folder with cameras of other programs; of several files, the one that names most counts."""
    cameras = camera_files_in(place) + (camera_files_in(folder) if folder.resolve() != place.resolve() else [])
    if not cameras:
        return None
    files = image_files(folder)
    found = {path: foreign_cameras(path, files) for path in cameras}
    path, named = max(found.items(), key=lambda item: len(item[1]))
    if not named:
        if above:
            return None
        raise DataError(f"{path} names none of the {len(files)} images in {folder}, such as {files[0].name}")
    if len(cameras) > 1:
        log.warning("the cameras of %s are used; ignored: %s", path, ", ".join(str(p) for p in cameras if p != path))
    return [_photo(file, camera, path, as_stored=True) for file, camera in named]


def _photo(path: Path, camera: NamedCamera, cameras: Path, as_stored: bool = False) -> Picture:
    """Returns a photograph with its camera, that of the whole photograph if the file has it."""
    photo = camera.photo
    if photo is None or composed(photo.name) != composed(path.name):
        photo = Photo(path.name, camera.width, camera.height, camera.intrinsics)
    undistortion = undistortion_of(photo.lens) if photo.lens else None
    expected = undistortion.lens_size if undistortion else (photo.height, photo.width)
    size, upright = size_on_disk(path, path.parent.name, expected, str(cameras), as_stored)
    intrinsics = torch.from_numpy(photo.intrinsics)
    pose = torch.from_numpy(camera.world_to_camera)

    def read(wanted: tuple[int, int]) -> Frames:
        """Reads the undistorted photograph with its mask and camera, reduced to about the wanted size."""
        pixels = read_color(path, path.parent.name, upright=upright, least=wanted)
        mask = mask_for(path, upright)
        if undistortion is None:
            frames = frame_of(shrunk(pixels, wanted), mask)
        else:
            reduced = undistortion_of(photo.lens, (pixels.shape[0], pixels.shape[1]))
            frames = frame_of(reduced.color(pixels), None if mask is None else undistortion.depth(mask))
        height, width = frames.images.shape[-2:]
        matrix = resize_intrinsics(intrinsics, width / photo.width, height / photo.height)
        return replace(frames, world_to_camera=pose.float()[None], intrinsics=matrix.float()[None])

    return Picture(
        path.stem,
        (photo.height, photo.width) if undistortion else size,
        read,
        f"{cameras.name} {cameras.parent}",
        path=path,
        pose=camera.world_to_camera,
        intrinsics=photo.intrinsics,
        is_metric=camera.metres_per_unit == 1,
        lens=photo.lens,
    )


def describe(images: Any) -> str:
    """Describes the input in a few words, for messages."""
    items = [str(item) if isinstance(item, (str, Path)) else type(item).__name__ for item in as_items(images)]
    return some(items, 3)
