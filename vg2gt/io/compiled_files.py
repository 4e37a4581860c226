"""Files of compiled kernels, which no other process, full disk or power failure can spoil."""

from __future__ import annotations

import hashlib
import logging
import os
import pickle
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from numba.core.caching import FunctionCache
from numba.core.serialize import dumps

from vg2gt.io.files import write_cached

log = logging.getLogger(__name__)


class KernelCache(FunctionCache):
    """What a kernel was compiled to, one file for all that decides it; what cannot be read is compiled again.

    numba numbers its files and keeps the numbers in an index. Two processes that compile one kernel for different
    arguments at a time may give both the same number, and the one would run the other's code; a full disk ends a
    command, and half a file every later one.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = _Files(Path(self._cache_path), self._impl.filename_base)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The kernel for these arguments, or None."""
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:  # other versions of numba write other things
            log.warning("a compiled kernel in %s cannot be used (%s): compiled again", self.cache_path, error)
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keeps the kernel for these arguments where the disk admits it."""
        with suppress(OSError):  # of its folder; a file that cannot be written is told
            super().save_overload(sig, data)


class _Files:
    """In place of numba's files: named by their key, written in one piece, with a checksum."""

    def __init__(self, folder: Path, name: str) -> None:
        self.folder, self.name = folder, name

    def load(self, key: object) -> Any:
        """What was saved under this key, or None."""
        path = self._path(key)
        try:
            with path.open("rb") as file:
                owner, content = os.fstat(file.fileno()).st_uid, file.read()
        except OSError:
            return None
        if os.name == "posix" and owner not in (0, os.geteuid()):
            log.warning("%s belongs to another user, whose code is not run: compiled again", path)
            return None
        checksum, data = content[:_CHECKSUM], content[_CHECKSUM:]
        if hashlib.sha256(data).digest() != checksum:
            log.warning("%s is damaged: compiled again", path)
            return None
        return pickle.loads(data)  # this user's or the administrator's own: numba pickles what belongs to code

    def save(self, key: object, data: object) -> None:
        """Keeps ``data`` under this key."""
        content = dumps(data)
        write_cached(self._path(key), hashlib.sha256(content).digest() + content, self.folder)

    def flush(self) -> None:
        """Forgets everything."""
        for path in self.folder.glob(f"{self.name}.*.nbc"):
            path.unlink(missing_ok=True)

    def _path(self, key: object) -> Path:
        return self.folder / f"{self.name}.{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}.nbc"


_CHECKSUM = hashlib.sha256().digest_size
