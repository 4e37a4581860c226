"""Which files of a folder are photographs: there and in its subfolders, and what is passed over."""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

from PIL import features

from vg2gt.data.sources.masks import image_beside, image_of_mask
from vg2gt.data.sources.parsing import IMAGE_FOLDERS, OTHER_FOLDERS, PHOTO_SUFFIXES, is_image_folder
from vg2gt.io.errors import some
from vg2gt.io.files import by_number
from vg2gt.io.record3d import R3D
from vg2gt.io.video import VIDEO_SUFFIXES

log = logging.getLogger(__name__)

# Images that are not read as photographs, and those that cameras store in addition to or instead of them.
_OTHER_SUFFIXES = (
    *(".exr", ".gif", ".hdr", ".hif", ".insp", ".j2k", ".jp2", ".jxl", ".jxr", ".psb", ".psd", ".svg", ".tga", ".xcf"),
    *(".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".gpr", ".iiq", ".kdc", ".mef", ".mos", ".mrw"),
    *(".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw", ".x3f"),
    *(".360", ".3gp", ".flv", ".insv", ".lrv", ".m2ts", ".mpeg", ".mpg", ".mts", ".mxf", ".ogv", ".ts", ".wmv"),
    *(R3D, *VIDEO_SUFFIXES),
)
_NOT_THERE = (".crdownload", ".download", ".icloud", ".part", ".partial")  # of files that are not downloaded yet
_DEPTH = ("_depth", "-depth", ".depth", "_normal", "_normals")  # in the names of other images next to photographs
_RESULTS = ("report.json", "sfm.json", "scene.ply")  # in folders that vg2gt has written


def is_photo(path: Path) -> bool:
    """Returns whether a file has the suffix of a photograph and is not hidden."""
    return path.suffix.lower() in PHOTO_SUFFIXES and not path.name.startswith(".")


def image_files(folder: Path, warn: bool = False) -> list[Path]:
    """Lists the photographs of a folder and its subfolders, sorted by the numbers in their names.

    If a subfolder with a name of images (``images``, ``color``, ...) has more, only those in it. Folders of masks,
    depth and the like, hidden ones, links, and those that ``vg2gt`` has written are left out.

    Args:
        folder: the folder.
        warn: warn about its images that are not listed, and about images of several folders.

    Raises:
        ValueError: if there are none.
    """
    inside = image_folders(folder)
    found = {place: _photos(place, inside if place == folder else []) for place in (folder, *inside)}
    taken = max(found, key=lambda place: len(found[place]))  # the first of equals
    if not found[taken]:
        suffixes = ", ".join(PHOTO_SUFFIXES)
        folders = sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
        skipped = [f"{path.name}/" for path in folders if _is_skipped(path)]
        others = _others(folder) + (f"; not searched, by their names: {some(skipped)}" if skipped else "")
        raise ValueError(f"no images in {folder} (looked for {suffixes}, there and in its subfolders){others}")
    if warn:
        _name_passed_over(folder, taken, found)
    return sorted(found[taken], key=lambda file: (len(file.relative_to(taken).parts) > 1, by_number(str(file))))


def _name_passed_over(folder: Path, taken: Path, found: Mapping[Path, list[Path]]) -> None:
    if taken != folder and found[folder]:
        log.warning("images are taken from %s; %d next to it are ignored", taken, len(found[folder]))
    places = Counter(str(file.parent.relative_to(taken)) for file in found[taken])
    if len(places) > 1:
        named = [f"{place} ({count})" for place, count in places.items()]
        log.warning("the images of several folders in %s are taken together: %s", taken, some(named))
    if others := _others(taken):
        log.warning("%s has more than the %d photographs%s", taken, len(found[taken]), others)


def image_folders(folder: Path) -> list[Path]:
    """Lists the image subfolders of a folder, ignoring case; reduced ones (``images_4``) come last."""
    found = [path for path in folder.iterdir() if path.is_dir() and is_image_folder(path.name)]
    order = {name: number for number, name in enumerate(IMAGE_FOLDERS)}
    return sorted(found, key=lambda path: (order.get(path.name.lower(), len(order)), by_number(path.name)))


def _can_read(path: Path) -> bool:
    """Returns whether a photograph exists, not only a link, and the installed Pillow can read its format."""
    return path.exists() and (path.suffix.lower() != ".avif" or bool(features.check("avif")))


def _is_map(file: Path) -> bool:
    """Returns whether a file is the depth or normals of an image next to it; Blender numbers them, as ``_0001``."""
    unnumbered = file.with_name(re.sub(r"_\d{4}$", "", file.stem) + file.suffix)
    return image_beside(unnumbered, _DEPTH) is not None


def _photos(folder: Path, without: list[Path]) -> list[Path]:
    found = [file for file in _walk(folder, without) if is_photo(file) and _can_read(file)]
    return [file for file in found if image_of_mask(file) is None and not _is_map(file)]


def _others(folder: Path) -> str:
    """Describes images and videos that are not read; empty if there are none."""
    known = image_folders(folder)
    files = [
        str(file.relative_to(folder))
        for file in _walk(folder, known)
        if (
            not file.name.startswith(".")
            and (file.suffix.lower() in _OTHER_SUFFIXES or (is_photo(file) and not _can_read(file)))
        )
        or _is_map(file)
    ]
    waiting = [str(file.relative_to(folder)) for file in _walk(folder, known) if file.suffix.lower() in _NOT_THERE]
    links = [path for path in folder.iterdir() if path.is_symlink() and path.is_dir() and path not in known]
    files += [f"{path.name}/ (a link)" for path in links if not OTHER_FOLDERS.fullmatch(path.name)]
    said = f"; not downloaded completely: {some(sorted(waiting, key=by_number))}" if waiting else ""
    if not files:
        return said
    named = some(sorted(files, key=by_number))
    return f"{said}; not read: {named} (save photographs as JPEG or PNG, give a video by itself)"


def _is_skipped(folder: Path) -> bool:
    """Returns whether a folder holds other things than photographs, by its name or because vg2gt has written it."""
    return bool(OTHER_FOLDERS.fullmatch(folder.name)) or any((folder / name).is_file() for name in _RESULTS)


def _walk(folder: Path, without: list[Path]) -> Iterator[Path]:
    """Yields the files of a folder and of its subfolders of photographs, except those ``without``."""
    folders = []
    for path in sorted(folder.iterdir()):
        if not path.is_dir():
            yield from [path] if path.is_file() or path.is_symlink() else []
        elif path not in without and not path.is_symlink() and not _is_skipped(path):
            folders.append(path)
    for path in folders:
        yield from _walk(path, [])
