"""One process at a time in a folder."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

NAME = ".lock"


@contextmanager
def only_process_in(folder: str | Path) -> Iterator[None]:
    """Holds a folder for this process; the lock ends with the process, however it ends.

    Systems without POSIX locks (Windows) and file systems that refuse them are not locked.

    Args:
        folder: made if needed, and gone again if nothing was written to it: a refused start leaves none. What is
            written to it besides the lock's file is the caller's.

    Raises:
        BlockingIOError: if another process holds the folder, naming it.
    """
    folder = Path(folder)
    new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    descriptor = _locked(folder / NAME)
    try:
        yield
    finally:
        if descriptor is not None:
            (folder / NAME).unlink(missing_ok=True)
            os.close(descriptor)
        if new:
            with suppress(OSError):  # it holds something, or was renamed
                folder.rmdir()


def _locked(path: Path) -> int | None:
    """Descriptor of the file while it is locked; None where there are no locks."""
    try:
        import fcntl
    except ImportError:
        return None
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            # Not flock, whose locks would live on in the forked processes that load data.
            fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError) as error:
            holder = os.read(descriptor, 200).decode(errors="replace").strip()
            os.close(descriptor)
            raise BlockingIOError(
                f"{path.parent} is in use by another process ({holder or 'unknown'}): wait until it has ended, or "
                "choose another name="
            ) from error
        except OSError:
            os.close(descriptor)
            return None
        if _same_file(descriptor, path):
            os.truncate(descriptor, 0)
            os.write(descriptor, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
            return descriptor
        os.close(descriptor)  # its last holder has deleted it in the meantime


def _same_file(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
