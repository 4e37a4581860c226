"""Small files, written under a temporary name and renamed, so that readers never see a partial file."""

from __future__ import annotations

import errno
import json
import logging
import os
import re
import secrets
import shutil
import stat
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from vg2gt.io.errors import FormatError

log = logging.getLogger(__name__)

_unwritable: set[Path] = set()
# What Windows does not allow in names of files.
_REFUSED = re.compile(r'[<>:"\\|?*\x00-\x1f]')
_DEVICE = re.compile(r"(con|prn|aux|nul|(com|lpt)[1-9¹²³]) *(\..*)?", re.IGNORECASE)


@contextmanager
def replacing(path: str | Path, durable: bool = False) -> Iterator[Path]:
    """Yields a temporary path that replaces ``path`` at the end of the block, or is deleted on an error.

    Args:
        path: the file; its folder is created if needed.
        durable: flush the file to disk, so that its content survives a power failure.

    Raises:
        OSError: if the file cannot be written (a full disk), naming it; its previous content is kept.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _temporary_name(path)
    try:
        yield temporary
        if durable:
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
        os.replace(temporary, path)
        if durable:
            _flush_folder(path.parent)
    except OSError as error:
        raise OSError(error.errno, f"{path} could not be written: {error.strerror or error}") from error
    finally:
        with suppress(OSError):  # on a failing disk; the first error says more
            temporary.unlink(missing_ok=True)


def portable(name: str) -> str:
    """Returns a relative path that all systems allow: without names of devices and characters that Windows refuses."""
    return "/".join(_portable_part(part) for part in name.split("/"))


def _portable_part(part: str) -> str:
    part = _REFUSED.sub("_", part)
    if part not in (".", "..") and part[-1:] in (".", " "):
        part = f"{part[:-1]}_"
    return f"_{part}" if _DEVICE.fullmatch(part) else part


def _temporary_name(path: Path) -> Path:
    """Returns a random name next to ``path``; process ids are not unique across containers."""
    return path.with_name(f".{path.name[:50]}.{secrets.token_hex(8)}.tmp")  # a name can have 255 bytes


def write_bytes(path: str | Path, content: bytes, durable: bool = False) -> Path:
    """Writes ``content`` atomically; returns the path. Arguments and errors as in :func:`replacing`."""
    with replacing(path, durable) as temporary:
        temporary.write_bytes(content)
    return Path(path)


def _flush_folder(folder: Path) -> None:
    """Flushes the names in a folder to disk, after a rename, if the file system can."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def write_cached(path: str | Path, content: bytes, cache: str | Path) -> None:
    """Writes a cache file; if that fails, continues without it.

    A full or read-only disk is logged once per process and folder, and nothing more is written there.

    Args:
        path: the file.
        content: content of the file.
        cache: the cache folder above it that the user chose, for the message.
    """
    cache = Path(cache)
    if cache in _unwritable:
        return
    try:
        write_bytes(path, content)
    except OSError as error:
        _unwritable.add(cache)
        log.warning("caching to %s is disabled, because the folder cannot be written to: %s", cache, error)


def write_text(path: str | Path, content: str) -> Path:
    """Writes UTF-8 text atomically and flushes it to disk; returns the path. Errors as in :func:`write_bytes`."""
    return write_bytes(path, content.encode(), durable=True)


def write_json(path: str | Path, content: Any) -> Path:
    """Writes indented JSON atomically; returns the path."""
    return write_text(path, json.dumps(content, indent=2, sort_keys=True) + "\n")


@contextmanager
def whole_folder(target: Path) -> Iterator[Path]:
    """Yields a folder to write into, which replaces ``target`` at the end of the block; on an error it is removed."""
    target = target.resolve()  # a link stays one
    staged = _temporary_name(target)
    staged.mkdir(parents=True)
    try:
        yield staged
        if target.exists():
            before = _temporary_name(target)
            os.replace(target, before)  # removing it here would take time without either
            os.replace(staged, target)
            shutil.rmtree(before)
        else:
            os.replace(staged, target)
    finally:
        shutil.rmtree(staged, ignore_errors=True)


def regular(path: str | Path) -> Path:
    """Returns the path if it is safe to open: a named pipe may block its reader, a device may be endless.

    Raises:
        FileNotFoundError: if there is no such file.
        OSError: if it is a pipe, a socket or a device. A folder passes; its reader reports it.
    """
    path = Path(path)
    mode = path.stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise OSError(errno.EINVAL, f"{path} is no regular file but a pipe, a socket or a device")
    return path


def read_json(path: str | Path, content: bytes | None = None) -> Any:
    """Reads a JSON file, or parses its ``content`` if it was read already.

    Raises:
        FormatError: if it is not valid JSON, naming the file.
    """
    try:
        return json.loads(regular(path).read_bytes() if content is None else content)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{path}: not valid JSON ({error}); the file is truncated or damaged") from error


def composed(name: str) -> str:
    """Returns a name with composed umlauts and accents: macOS decomposes them in names of files, others do not."""
    return unicodedata.normalize("NFC", name)


def by_number(name: str) -> tuple[list[str | int], str]:
    """Sort key of a name: numbers in it sort by value, so that ``IMG_9`` comes before ``IMG_10``."""
    parts = re.split(r"(\d+)", name)  # odd entries are digits
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], name
