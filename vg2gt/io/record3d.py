"""Files of Record3D recordings: an ``.r3d`` archive (a ZIP) or the folder it was unpacked to.

Paths of files in an archive treat it as a folder: ``capture.r3d/rgbd/0.jpg``.
"""

from __future__ import annotations

import os
import re
import zipfile
from functools import lru_cache
from pathlib import Path

from vg2gt.io.errors import FormatError
from vg2gt.io.files import regular

R3D = ".r3d"
_FRAME = re.compile(r"rgbd/([0-9]{1,9})(\.[a-z]+)")  # other names are ignored, such as paths out of the folder


def is_archive(path: Path) -> bool:
    """Whether a path is an ``.r3d`` file."""
    return path.suffix.lower() == R3D and path.is_file()


def recorded_files(recording: Path, suffix: str) -> dict[int, Path]:
    """Returns a recording's files ``rgbd/N`` with a suffix (such as ``.jpg``), sorted by number.

    Raises:
        FormatError: if an archive cannot be read.
        OSError: if a folder cannot be read.
    """
    if is_archive(recording):
        names = _archive(recording).namelist()
    else:
        names = [f"rgbd/{path.name}" for path in (recording / "rgbd").iterdir()]
    found = {int(match[1]): name for name in names if (match := _FRAME.fullmatch(name)) and match[2] == suffix}
    return {number: recording / found[number] for number in sorted(found)}


def read_recorded(path: Path) -> bytes:
    """Reads a file of a recording.

    Raises:
        FileNotFoundError: if there is no such file.
        FormatError: if the archive is damaged.
    """
    place = next((folder for folder in list(path.parents)[:2] if is_archive(folder)), None)
    if place is None:
        return regular(path).read_bytes()
    try:
        return _archive(place).read(path.relative_to(place).as_posix())
    except KeyError as error:
        raise FileNotFoundError(f"{path} is not in the recording") from error
    except Exception as error:  # damaged bytes raise various errors of zipfile and zlib
        raise FormatError(f"{path}: cannot be read ({error}); the recording is damaged, export it again") from error


def unpack_lzfse(path: Path) -> bytes:
    """Reads and unpacks an LZFSE file of a recording.

    Raises:
        FormatError: if it is damaged.
        ImportError: if the package ``lzfse`` is not installed.
    """
    try:
        import lzfse  # pyright: ignore[reportMissingImports]: optional
    except ImportError as error:
        raise ImportError(f"{path.name} is read with lzfse: pip install 'vg2gt[phone]'") from error
    content = read_recorded(path)
    try:
        return lzfse.decompress(content)
    except (lzfse.error, MemoryError) as error:
        raise FormatError(f"{path}: damaged LZFSE data; export the recording again") from error


def _archive(path: Path) -> zipfile.ZipFile:
    try:
        return _open(str(regular(path)), path.stat().st_mtime_ns, os.getpid())
    except Exception as error:  # damaged archives raise various errors of zipfile
        raise FormatError(f"{path}: not a readable archive ({error}); export the recording again") from error


@lru_cache(maxsize=4)
def _open(path: str, changed: int, process: int) -> zipfile.ZipFile:
    """Opens an archive, cached per process: forked processes would share the position in an open file."""
    return zipfile.ZipFile(path)
