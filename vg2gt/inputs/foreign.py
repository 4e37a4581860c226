"""Photographs with the cameras of other programs (:mod:`vg2gt.io.photogrammetry`), matched by name."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

from vg2gt.data.base import DataError
from vg2gt.data.sources.undistortion import is_pinhole, lens_text, undistortion_of
from vg2gt.inputs.damaged import read_each
from vg2gt.io.cameras_json import NamedCamera, Photo
from vg2gt.io.colmap import colmap_intrinsics, require_pycolmap
from vg2gt.io.errors import FormatError
from vg2gt.io.files import composed
from vg2gt.io.image_files import image_size, same_shape
from vg2gt.io.photogrammetry import ForeignCamera, is_camera_file, read_photogrammetry

_PLACES = (".", "bundle")  # subfolders with files of cameras
# Of OpenMVG, OpenSfM, Meshroom, Pix4D, Metashape and RealityScan (other exports, projects), and any tables.
_NAMED = ("sfm_data.json", "reconstruction.json", "_external_camera_parameters.txt", "_camera_parameters.txt")
_MAYBE = (".abc", ".csv", ".nvm", ".out", ".p4d", ".psx", ".psz", ".rcproj", ".rsproj", ".sfm", ".xml")


def camera_files_in(folder: Path) -> list[Path]:
    """Returns the files of cameras in a folder or its ``bundle/``."""
    places = [folder / place for place in _PLACES if (folder / place).is_dir()]
    return [file for place in places for file in sorted(place.iterdir()) if is_camera_file(file)]


def unread_camera_files(folder: Path) -> list[Path]:
    """Returns files in a folder that may have cameras, by their names, but are of no kind that is read."""
    files = [file for file in sorted(folder.iterdir()) if file.is_file() and not is_camera_file(file)]
    return [
        file
        for file in files
        if file.suffix.lower() in _MAYBE or any(map(file.name.endswith, _NAMED)) or _is_sidecar_of_reality_scan(file)
    ]


def _is_sidecar_of_reality_scan(file: Path) -> bool:
    """Returns whether an XMP file has the pose of its photograph; those of photo editors have none."""
    if file.suffix.lower() != ".xmp":
        return False
    with file.open("rb") as opened:
        return b"capturingreality.com/ns/xcr" in opened.read(4096)


def matched(cameras: Sequence[ForeignCamera], files: Sequence[Path]) -> dict[Path, ForeignCamera]:
    """Returns the cameras of image files: by as much of the path as tells them apart, then by name, then by stem."""
    found: dict[Path, ForeignCamera] = {}
    for parts in (3, 2, 1):
        for with_suffix in (True, False):
            known = _by_key(cameras, parts, with_suffix)
            keys = {file: _key(file.as_posix(), parts, with_suffix) for file in files}
            counts = Counter(keys.values())
            for file, key in keys.items():
                if file not in found and counts[key] == 1 and key in known:
                    found[file] = known[key]
    return {file: found[file] for file in files if file in found}


def _by_key(cameras: Sequence[ForeignCamera], parts: int, with_suffix: bool) -> Mapping[str, ForeignCamera]:
    keys = [_key(camera.name, parts, with_suffix) for camera in cameras]
    counts = Counter(keys)
    return {key: camera for key, camera in zip(keys, cameras, strict=True) if counts[key] == 1}


def _key(name: str, parts: int, with_suffix: bool) -> str:
    path = PurePosixPath(name.replace("\\", "/"))
    short = path.name if with_suffix else path.stem if path.suffix else path.name
    return composed("/".join([*path.parts[:-1], short][-parts:]).lower())


def _named_camera(camera: ForeignCamera, name: str, size: tuple[int, int]) -> NamedCamera:
    """Returns a camera of an image of ``(height, width)`` as stored: that of its undistorted pinhole image.

    Raises:
        ValueError: if the camera is of an image of another shape, or the distortion is implausible.
    """
    require_pycolmap("reading cameras of photogrammetry programs")
    import pycolmap  # pyright: ignore[reportMissingImports]

    height, width = camera.size or size
    if not same_shape((height, width), size):
        raise ValueError(
            f"{name} is {size[1]}x{size[0]} pixels, but its camera is of {width}x{height}: use the images that the "
            "cameras were made for, or resized ones"
        )
    model, params = camera.lens((height, width))
    lens = pycolmap.Camera(model=model, width=width, height=height, params=params)
    if is_pinhole(lens):
        return NamedCamera(name, width, height, colmap_intrinsics(lens), camera.world_to_camera)
    text = lens_text(lens, size)
    undistorted = undistortion_of(text)
    photo = Photo(name, undistorted.size[1], undistorted.size[0], undistorted.intrinsics, text)
    return NamedCamera(name, photo.width, photo.height, photo.intrinsics, camera.world_to_camera, photo)


def foreign_cameras(path: Path, files: Sequence[Path]) -> list[tuple[Path, NamedCamera]]:
    """Returns the image files that a file of cameras names, with their cameras; damaged images are left out by name.

    Raises:
        DataError: if the file is damaged, a camera does not fit its image, or no image is left.
    """
    try:
        cameras = matched(read_photogrammetry(path), files)
        return read_each(cameras, lambda file: (file, _named_camera(cameras[file], file.name, image_size(file, ""))))
    except DataError:
        raise
    except FormatError as error:
        raise DataError(str(error)) from error
    except ValueError as error:
        raise DataError(f"{path}: {error}") from error


def cameras_to_render(path: Path, files: Sequence[Path]) -> list[NamedCamera]:
    """Returns all cameras of a file; those of unknown size have that of their image.

    Raises:
        FormatError: if the file is damaged, or a size is not known.
    """
    cameras = read_photogrammetry(path)
    images = {id(camera): file for file, camera in matched(cameras, files).items()}
    found = []
    for camera in cameras:
        size = camera.size or (image_size(images[id(camera)], "") if id(camera) in images else None)
        if size is None:
            raise FormatError(f"{path} does not tell the size of {camera.name}: put its images next to it")
        found.append(replace(_named_camera(camera, camera.name or "view", size), photo=None))
    return found
