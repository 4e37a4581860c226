"""Exclusive use of a folder by one process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

NAME = ".lock"


@contextmanager
def only_process_in(folder: str | Path) -> Iterator[None]:
    """Locks a folder, creating it if needed; on exit, removes a folder it created if that is empty.

    Raises:
        BlockingIOError: if another process holds the lock.
    """
    folder = Path(folder)
    new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / NAME)
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise BlockingIOError(
            f"{folder} is in use by another process: wait until it has ended, or choose another name="
        ) from error
    except NotImplementedError:  # a file system without locks
        pass
    try:
        yield
    finally:
        (folder / NAME).unlink(missing_ok=True)
        lock.release()
        if new:
            with suppress(OSError):  # not empty
                folder.rmdir()
