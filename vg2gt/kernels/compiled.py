"""numba kernels, cached on disk.

numba detects changes only in the file that defines a kernel, but constants and functions may come from other files. The
cache folder is therefore named by a hash of the versions and of all sources that a kernel can be made of.

If a new numba breaks this: :class:`_Locator`, :class:`_Cache` and ``no_cfunc_wrapper`` rely on private names of
``numba.core.caching``. Replace :func:`kernel` by ``numba.njit(cache=True)`` with ``numba.config.CACHE_DIR`` set to
:func:`_folder`. Kernels stay correct; lost are the recovery from damaged files and full disks, and the safety of two
processes that compile at once (``tests/io/test_compiled.py``).
"""

from __future__ import annotations

import atexit
import gc
import hashlib
import logging
import os
import platform
import secrets
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import llvmlite.binding
import numba
from numba.core import codegen, event
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator
from numba.extending import register_jitable

log = logging.getLogger(__name__)

PACKAGES = Path(__file__).resolve().parents[2]
SHARED = Path(__file__).with_name("compiled_math.py")
"""The only module outside their room (such as ``vg2gt/kernels``) that kernels may import from, as a test checks."""
_VARIABLE = "NUMBA_CACHE_DIR"

config: Any = numba.config  # pyright: ignore[reportPrivateImportUsage]


# LLVM prefers 256-bit vectors on Intel; processors with VBMI2 run 512-bit vectors at full speed.
if config.CPU_NAME is None and config.CPU_FEATURES is None:
    with suppress(RuntimeError):  # LLVM does not know the features of every host
        if llvmlite.binding.get_host_cpu_features().get("avx512vbmi2"):
            config.CPU_FEATURES = codegen.get_host_cpu_features() + ",-prefer-256-bit"


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator like ``numba.njit(**options)``: compiles at the first call and caches in :func:`cache_folder`.

    A kernel defined inside a function must refer to other kernels as module globals. numba's cache key contains the
    values in the closure, and a kernel is a different value in every process.
    """
    options["no_cfunc_wrapper"] = True  # never called as a C function; saves compile time

    def compile_later(function: Callable[..., Any]) -> Any:
        """Returns the kernel, compiled at its first call."""
        made: Any = numba.njit(**options)(function)
        if _Locator.from_function(function, function.__code__.co_filename) is not None:
            made._cache = _Cache(function)
        return made

    return compile_later


def kernel_part(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator for functions that kernels call: compiled and cached with them, interpreted if called from Python."""
    return register_jitable(no_cfunc_wrapper=True, **options)


class _Locator(_CacheLocator):
    """Puts all kernels of the same sources into one folder, wherever the sources are installed."""

    def __init__(self, folder: Path, source: Path, line: int) -> None:
        self._folder, self._place = folder, f"{source.parent.name}-{line}"

    def get_cache_path(self) -> str:
        """Returns the folder."""
        return str(self._folder)

    def get_source_stamp(self) -> None:
        """Returns nothing: the name of the folder tells the sources."""

    def get_disambiguator(self) -> str:
        """Returns what distinguishes functions of the same name in files of the same name."""
        return self._place

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> _Locator | None:
        """Returns the locator of a kernel, or None if no folder is writable."""
        source = Path(py_file).resolve()
        folder = _folder(PACKAGES.joinpath(*source.relative_to(PACKAGES).parts[:2]))
        return None if folder is None else cls(folder, source, py_func.__code__.co_firstlineno)


class _Implementation(CompileResultCacheImpl):
    _locator_classes: ClassVar = [_Locator]


class _Cache(FunctionCache):
    """numba's cache, but a full disk or a damaged file leads to another compilation instead of an error."""

    _impl_class = _Implementation

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        # numba numbers its files: two processes could use one name for two signatures and run each other's code
        self._cache_file._data_name_pattern = f"{self._impl.filename_base}.{{number:d}}-{secrets.token_hex(8)}.nbc"

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Returns the cached kernel for these arguments, or None."""
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:  # whatever unpickling raises
            log.warning("damaged compiled kernel in %s (%s): compiling it again", self.cache_path, error)
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Saves the kernel for these arguments, if the disk has room."""
        with suppress(OSError):
            super().save_overload(sig, data)


class _Announcement(event.Listener):
    """Logs once that kernels are being compiled, which takes a while."""

    _said = False

    def on_start(self, event: event.Event) -> None:
        """Logs at the first compilation."""
        if not self._said:
            log.info("compiling kernels (once per machine and version, about 20 s in all)")
            gc.freeze()  # otherwise garbage collection keeps scanning all of torch during compilation
            atexit.register(gc.unfreeze)  # otherwise Triton reports leaks at the end
        self._said = True

    def on_end(self, event: event.Event) -> None:
        """Does nothing."""


event.register("numba:compile", _Announcement())


@lru_cache
def _folder(package: Path) -> Path | None:
    """Returns the cache folder for a package's kernels, or None if it is not writable."""
    base = cache_folder()
    if base is None:
        log.warning(
            "cannot cache compiled kernels, so every process recompiles them; set %s to a writable folder", _VARIABLE
        )
        return None
    content = hashlib.sha256(f"{numba.__version__} {llvmlite.__version__} {platform.python_version()}".encode())
    for path in [Path(__file__), SHARED, *sorted(package.rglob("*.py"))]:
        content.update(path.name.encode() + b"\0" + path.read_bytes())
    folder = base / f"{package.name}-{content.hexdigest()[:16]}"
    folder.mkdir(exist_ok=True)
    return folder


def cache_folder() -> Path | None:
    """Returns the folder for compiled kernels and this machine's self-check results, or None if it is not writable."""
    given = os.environ.get(_VARIABLE)
    try:
        home = Path(given) if given else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folder = home / "vg2gt" if given else home / "vg2gt" / "kernels"
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except (OSError, RuntimeError):  # RuntimeError: no home directory
        return None
