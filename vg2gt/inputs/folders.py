"""Which files of a folder are photographs: there and in its subfolders, and what is passed over."""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from PIL import features

from vg2gt.data.sources.masks import IMAGE_FOLDERS, is_image_folder
from vg2gt.data.sources.parsing import IMAGE_SUFFIXES
from vg2gt.io.files import by_number
from vg2gt.io.record3d import R3D
from vg2gt.io.video import VIDEO_SUFFIXES

log = logging.getLogger(__name__)

HEIC_SUFFIXES = (".heic", ".heif")
PHOTO_SUFFIXES = (*IMAGE_SUFFIXES, *HEIC_SUFFIXES, ".avif", ".jfif", ".jpe")
# Images that are not read as photographs, and those that cameras store in addition to or instead of them.
_OTHER_SUFFIXES = (
    *(".arw", ".cr2", ".cr3", ".dng", ".exr", ".gif", ".hdr", ".insp", ".jp2", ".j2k", ".jxl", ".nef", ".orf", ".pef"),
    *(".psd", ".raf", ".raw", ".rw2", ".srw", ".svg", ".tga", ".insv", ".lrv", R3D, *VIDEO_SUFFIXES),
)
# Subfolders that hold other things than photographs.
_NOT_PHOTOS = re.compile(
    r"[._@].*|masks?|depths?|depth[_-].*|.*[_-]depths?|normals?|conf(idence)?|sparse|dense|stereo|semantics?|labels?|"
    r"thumb(nail)?s?|images_\d+",
    re.IGNORECASE,
)
_RESULTS = ("report.json", "sfm.json", "scene.ply")  # in folders that vg2gt has written


def is_photo(path: Path) -> bool:
    """Returns whether a file has the suffix of a photograph and is not hidden."""
    return path.suffix.lower() in PHOTO_SUFFIXES and not path.name.startswith(".")


def can_read(path: Path) -> bool:
    """Returns whether the installed Pillow can read a photograph's format, by its suffix."""
    return path.suffix.lower() != ".avif" or bool(features.check("avif"))


def image_files(folder: Path) -> list[Path]:
    """Lists the photographs of a folder and its subfolders, sorted by the numbers in their names.

    If a subfolder with a name of images (``images``, ``color``, ...) has more, only those in it. Folders of masks,
    depth and the like, hidden ones, and those that ``vg2gt`` has written are left out.

    Raises:
        ValueError: if there are none.
    """
    found = _by_place(folder)
    taken = max(found, key=lambda place: len(found[place]))  # the first of equals
    if not found[taken]:
        suffixes = ", ".join(PHOTO_SUFFIXES)
        raise ValueError(f"no images in {folder} (looked for {suffixes}, there and in its subfolders){_others(folder)}")
    return sorted(found[taken], key=lambda file: (len(file.relative_to(taken).parts) > 1, by_number(str(file))))


def name_passed_over(folder: Path) -> None:
    """Warns about images of a folder that :func:`image_files` does not list, and says from which folders it does."""
    found = _by_place(folder)
    taken = max(found, key=lambda place: len(found[place]))
    if taken != folder and found[folder]:
        log.warning("images are taken from %s; %d next to it are ignored", taken, len(found[folder]))
    places = Counter(str(file.parent.relative_to(taken)) for file in found[taken])
    if len(places) > 1:
        named = ", ".join(f"{place} ({count})" for place, count in places.items())
        log.warning("the images of several folders in %s are taken together: %s", taken, named)
    if others := _others(taken):
        log.warning("%s has more than the %d photographs%s", taken, len(found[taken]), others)


def image_folders(folder: Path) -> list[Path]:
    """Lists the image subfolders of a folder, ignoring case; reduced ones (``images_4``) come last."""
    found = [path for path in folder.iterdir() if path.is_dir() and is_image_folder(path.name)]
    order = {name: number for number, name in enumerate(IMAGE_FOLDERS)}
    return sorted(found, key=lambda path: (order.get(path.name.lower(), len(order)), by_number(path.name)))


def _by_place(folder: Path) -> dict[Path, list[Path]]:
    """Returns the photographs of a folder, without its image subfolders, and those of each of these."""
    inside = image_folders(folder)
    places = {place: [file for file in _walk(place, []) if is_photo(file) and can_read(file)] for place in inside}
    own = [file for file in _walk(folder, inside) if is_photo(file) and can_read(file)]
    return {folder: own, **places}


def _others(folder: Path) -> str:
    """Describes images and videos that are not read; empty if there are none."""
    files = [
        str(file.relative_to(folder))
        for file in _walk(folder, image_folders(folder))
        if not file.name.startswith(".")
        and (file.suffix.lower() in _OTHER_SUFFIXES or (is_photo(file) and not can_read(file)))
    ]
    if not files:
        return ""
    named = ", ".join(sorted(files, key=by_number)[:10]) + (f" and {len(files) - 10} more" if len(files) > 10 else "")
    return f"; not read: {named} (save photographs as JPEG or PNG, give a video by itself)"


def _walk(folder: Path, without: list[Path]) -> Iterator[Path]:
    """Yields the files of a folder and of its subfolders of photographs, except those ``without``."""
    folders = []
    for path in sorted(folder.iterdir()):
        if not path.is_dir():
            yield from [path] if path.is_file() else []
        elif path not in without and not path.is_symlink() and not _NOT_PHOTOS.fullmatch(path.name):
            folders.append(path)
    for path in folders:
        if not any((path / name).is_file() for name in _RESULTS):
            yield from _walk(path, [])
