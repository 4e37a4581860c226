"""Pictures with the cameras that lie beside them: cameras.json, transforms.json, a COLMAP model, a list of poses."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from vg2gt.data.base import DataError, Frames
from vg2gt.data.sources.colmap_model import COLMAP, model_folder_of
from vg2gt.data.sources.files import FileSource
from vg2gt.data.sources.nerfstudio import Nerfstudio
from vg2gt.data.sources.phone import app_of
from vg2gt.data.sources.rgbd import RGBDFolder
from vg2gt.geometry.cameras import resize_intrinsics
from vg2gt.io.cameras_json import NamedCamera, read_cameras_json
from vg2gt.io.image_files import image_size, read_color
from vg2gt.io.nerfstudio import read_transforms
from vg2gt.io.record3d import R3D
from vg2gt.reconstruction.pictures import (
    IMAGE_FOLDERS,
    ImagesLike,
    Picture,
    as_items,
    check_choice,
    evenly,
    existing_path,
    frame_of,
    image_files,
    shrunk,
    with_unique_names,
)

log = logging.getLogger(__name__)

_CAMERAS, _TRANSFORMS = "cameras.json", "transforms.json"
LAYOUTS = f"{_CAMERAS}, {_TRANSFORMS}, a COLMAP model in sparse/0, or poses.txt with K.txt"


def given_pictures(
    images: ImagesLike, every: int = 1, max_images: int | None = None, depth: bool = False
) -> list[Picture] | None:
    """Lists the pictures of folders that hold their cameras.

    In each folder, and in the one above if the folder is called ``images``, ``color`` or ``rgb``, is looked for, in
    this order: ``cameras.json``, ``transforms.json``, a COLMAP model, a recording with poses (with depth or without).

    Args:
        images: a folder or an ``.r3d`` file, or a sequence of such.
        every: take every this many-th picture only.
        max_images: take at most so many, evenly spread; None: all.
        depth: depth is needed as well: what has none is passed over.

    Returns:
        The pictures in order, their names unique; None if any of what was given has no cameras.

    Raises:
        FileNotFoundError: if a path does not exist.
        ValueError: if a file of cameras is damaged, or belongs to other images.
    """
    check_choice(every, max_images)
    found: list[Picture] = []
    for item in as_items(images):
        path = existing_path(item) if isinstance(item, (str, Path)) else None
        own = _given(path, depth) if path is not None and (path.is_dir() or app_of(path)) else None
        if own is None:
            return None
        found += own
    return with_unique_names(evenly(found[::every], max_images))


def recording_pictures(source: FileSource) -> list[Picture]:
    """The pictures of a source's only scene, with their cameras and depth.

    Raises:
        ValueError: if the source has several scenes.
    """
    if len(source.scenes) > 1:
        raise ValueError(f"there are {len(source.scenes)} recordings; give one of them: {', '.join(source.scenes)}")
    scene = source.scenes[0]
    index = source.scene_index(scene)
    kind = f"{type(source).__name__} {index.folder}"

    def picture(frame: int) -> Picture:
        def read(size: tuple[int, int]) -> Frames:
            return source.load(scene, [frame])

        points = source.point_depths(scene, frame) if isinstance(source, COLMAP) else None
        return Picture(index.color[index.row(frame)].stem, index.size, read, kind, source.has_depth, points)

    return [picture(frame) for frame in source.frames(scene)]


def _given(folder: Path, depth: bool) -> list[Picture] | None:
    for place, images in _places(folder):
        if not depth and (place / _CAMERAS).is_file():
            return _from_cameras_json(place / _CAMERAS, place / images)
        source = _source(place, images, depth)
        if source is not None:
            return recording_pictures(source)
    return None


def _places(folder: Path) -> Iterator[tuple[Path, str]]:
    """Folders where the cameras of a folder's images may lie, with the images' folder as seen from there."""
    yield folder, next((name for name in IMAGE_FOLDERS if (folder / name).is_dir()), ".")
    name = folder.resolve().name
    if name in IMAGE_FOLDERS:
        yield folder.resolve().parent, name


def _source(folder: Path, images: str, depth: bool) -> FileSource | None:
    """The recording that a folder holds, with depth where it has any; None for mere photographs."""
    if (folder / _TRANSFORMS).is_file():
        with_depth = any(frame.depth_file_path for frame in read_transforms(folder / _TRANSFORMS).frames)
        if with_depth or not depth:
            return Nerfstudio(str(folder), depth=with_depth)
    if not depth and model_folder_of(folder) is not None:
        return COLMAP(str(folder), images=images)
    if app_of(folder) is not None or any(folder.glob(f"*{R3D}")):
        # Colour at its full size where depth is not needed: a phone's is coarse.
        return RGBDFolder(str(folder), holdout=None, depth=depth)
    if (folder / "depth").is_dir() or any(folder.glob("frame-*.color.*")):
        return RGBDFolder(str(folder), holdout=None)
    if not depth and ((folder / "poses.txt").is_file() or (folder / "pose").is_dir() or (folder / "poses").is_dir()):
        return RGBDFolder(str(folder), holdout=None, depth=False)
    return None


def _from_cameras_json(path: Path, folder: Path) -> list[Picture]:
    """Pictures of a folder whose cameras a ``cameras.json`` names, by the file's name with or without its ending.

    Raises:
        ValueError: if it names none of them.
    """
    cameras = {Path(camera.name).name: camera for camera in read_cameras_json(path)}
    by_stem = {Path(name).stem: camera for name, camera in cameras.items()}
    files = image_files(folder)
    found = [(file, cameras.get(file.name) or by_stem.get(file.stem) or by_stem.get(file.name)) for file in files]
    pictures = [_photo(file, camera, path) for file, camera in found if camera is not None]
    if not pictures:
        raise DataError(f"{path} names none of the {len(files)} images in {folder}, such as {files[0].name}")
    if len(pictures) < len(files):
        without = ", ".join(file.name for file, camera in found if camera is None)
        log.warning(
            "%s has no cameras for %d images, which are left out: %s", path, len(files) - len(pictures), without
        )
    return pictures


def _photo(path: Path, camera: NamedCamera, cameras: Path) -> Picture:
    size = image_size(path, path.parent.name)
    # Sizes are whole pixels, so that both sides of a reduced image may be off by one.
    if abs(size[0] * camera.width / (size[1] * camera.height) - 1) > 2 / min(size):
        raise DataError(
            f"{path} is {size[1]}x{size[0]} pixels, but {cameras} was made for {camera.width}x{camera.height}: it is "
            "not the image the camera belongs to, nor a reduced one"
        )
    return Picture(path.stem, size, _reader(path, camera), f"{_CAMERAS} {cameras.parent}", path=path)


def _reader(path: Path, camera: NamedCamera) -> Callable[[tuple[int, int]], Frames]:
    def read(size: tuple[int, int]) -> Frames:
        frames = frame_of(shrunk(read_color(path, path.parent.name), size))
        height, width = frames.images.shape[-2:]
        intrinsics = torch.from_numpy(camera.intrinsics)
        intrinsics = resize_intrinsics(intrinsics, width / camera.width, height / camera.height)
        pose = torch.from_numpy(camera.world_to_camera)
        return replace(frames, world_to_camera=pose.float()[None], intrinsics=intrinsics.float()[None])

    return read


def describe(images: Any) -> str:
    """What was given, in a few words, for messages."""
    items = [str(item) if isinstance(item, (str, Path)) else type(item).__name__ for item in as_items(images)]
    return ", ".join(items[:3]) + (f" and {len(items) - 3} more" if len(items) > 3 else "")
