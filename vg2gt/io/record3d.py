"""Files of Record3D recordings: an ``.r3d`` archive (a ZIP) or the folder it was unpacked to, and their LZFSE.

A file in an archive is named as if the archive were a folder: ``capture.r3d/rgbd/0.jpg``. An LZFSE stream is blocks,
each with a header of four magic bytes and the number of bytes that it unpacks to; the last one is ``bvx$``.
"""

from __future__ import annotations

import os
import re
import struct
import zipfile
import zlib
from functools import lru_cache
from pathlib import Path

from vg2gt.io.errors import FormatError
from vg2gt.io.files import regular

R3D = ".r3d"
_FRAME = re.compile(r"rgbd/([0-9]{1,9})(\.[a-z]+)")  # and no other name, such as one that leads out of the folder
_MOST = 64 << 20  # bytes of a file in a recording: a photograph, the poses of an hour
_END = b"bvx$"
_SHORTEST_HEADER = 32
_DAMAGED = (OSError, KeyError, ValueError, RuntimeError, NotImplementedError, EOFError, zipfile.BadZipFile, zlib.error)


def is_archive(path: Path) -> bool:
    """Whether a path is an ``.r3d`` file."""
    return path.suffix.lower() == R3D and path.is_file()


def recorded_files(recording: Path, suffix: str) -> dict[int, Path]:
    """The files ``rgbd/N`` with an ending (``.jpg``) of a recording by their number, in its order.

    Raises:
        FormatError: if an archive is damaged.
        OSError: if it cannot be opened.
    """
    if is_archive(recording):
        names = _archive(recording).namelist()
    else:
        names = [f"rgbd/{path.name}" for path in (recording / "rgbd").iterdir()]
    found = {int(match[1]): name for name in names if (match := _FRAME.fullmatch(name)) and match[2] == suffix}
    return {number: recording / found[number] for number in sorted(found)}


def is_recorded(path: Path) -> bool:
    """Whether a recording has a file of this name in ``rgbd/``."""
    place = path.parent.parent
    return path.relative_to(place).as_posix() in _archive(place).NameToInfo if is_archive(place) else path.is_file()


def read_recorded(path: Path) -> bytes:
    """Reads a file of a recording.

    Raises:
        FormatError: if the archive is damaged, lacks the file, or the file is larger than any of its kind.
        OSError: if it cannot be opened.
    """
    place = next((folder for folder in list(path.parents)[:2] if is_archive(folder)), None)
    if place is None:
        _check_length(path, regular(path).stat().st_size)
        return path.read_bytes()
    archive = _archive(place)
    try:
        member = archive.getinfo(path.relative_to(place).as_posix())
        _check_length(path, member.file_size)
        return archive.read(member)
    except FormatError:
        raise
    except _DAMAGED as error:
        raise FormatError(f"{path}: cannot be read ({error}); the recording is damaged, export it again") from error


def _check_length(path: Path, length: int) -> None:
    if length > _MOST:
        raise FormatError(f"{path} has {length} bytes, at most {_MOST} were expected; the recording is damaged")


def unpacked_size(content: bytes, where: Path) -> int:
    """Bytes that an LZFSE stream says it unpacks to.

    Args:
        content: the stream.
        where: the file, for the message.

    Raises:
        FormatError: if it is no LZFSE stream, is cut off, or has matches for far more bytes than it says.
    """
    total = matches = at = 0
    try:
        while (magic := content[at : at + 4]) != _END:
            if magic == b"bvx-":  # as it is
                (raw,) = struct.unpack_from("<I", content, at + 4)
                at += 8 + raw
            elif magic == b"bvxn":  # LZVN
                raw, payload = struct.unpack_from("<II", content, at + 4)
                at += 12 + payload
            elif magic == b"bvx2":
                # 20 bits each: literals, their bytes, matches | the matches' bytes, at bit 40 | the header's bytes.
                raw, counts, states, header = struct.unpack_from("<IQQI", content, at + 4)
                if header < _SHORTEST_HEADER:
                    raise ValueError(f"a header of {header} bytes")
                at += header + (counts >> 20 & 0xFFFFF) + (states >> 40 & 0xFFFFF)
                matches += counts >> 40 & 0xFFFFF
            else:
                raise ValueError(f"block {magic!r}")
            total += raw
    except (struct.error, ValueError) as error:
        raise FormatError(f"{where}: no LZFSE data ({error}); the recording is damaged, export it again") from error
    if 3 * matches > total:  # each copies more than that; a stream that lies would unpack to gigabytes
        raise FormatError(f"{where}: {matches} matches in {total} bytes; the recording is damaged, export it again")
    return total


def unpack_lzfse(content: bytes, size: int, where: Path) -> bytes:
    """Unpacks LZFSE data of a known size.

    Args:
        content: the stream.
        size: bytes that it must unpack to.
        where: the file, for the message.

    Raises:
        FormatError: if it is damaged or of another size.
        ImportError: if the package ``lzfse`` is not installed.
    """
    try:
        import lzfse  # pyright: ignore[reportMissingImports]: optional
    except ImportError as error:
        raise ImportError(f"{where.name} is read with lzfse: pip install 'vg2gt[phone]'") from error
    said = unpacked_size(content, where)
    try:
        unpacked = lzfse.decompress(content) if said == size else b""
    except (lzfse.error, MemoryError) as error:  # matches without end; what the stream says it unpacks to is little
        raise FormatError(f"{where}: damaged LZFSE data; export the recording again") from error
    if len(unpacked) != size:
        found = said if said != size else len(unpacked)
        raise FormatError(f"{where} unpacks to {found} bytes, expected {size}; export the recording again")
    return unpacked


def _archive(path: Path) -> zipfile.ZipFile:
    state = regular(path).stat()
    try:
        return _open(str(path), state.st_mtime_ns, state.st_size, os.getpid())
    except (zipfile.BadZipFile, ValueError, NotImplementedError, OverflowError, struct.error) as error:
        raise FormatError(f"{path}: no readable archive ({error}); export the recording again") from error


@lru_cache(maxsize=4)
def _open(path: str, changed: int, size: int, process: int) -> zipfile.ZipFile:
    """Open archives, which list each file. A forked process opens its own: an open file has but one position."""
    return zipfile.ZipFile(path)
