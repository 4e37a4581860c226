"""Compiled kernels and where they are kept.

numba looks at the file that defines a kernel only: a constant or a function that a kernel takes from another file could
change, and yesterday's machine code would go on to run. Kernels are therefore kept in a folder named by a hash of all
the source they can be made of.
"""

from __future__ import annotations

import gc
import hashlib
import logging
import os
import platform
import shutil
import stat
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import llvmlite.binding
import numba
from numba.core import codegen, event
from numba.extending import register_jitable

from vg2gt.io import compiled_files
from vg2gt.io.compiled_files import KernelCache

log = logging.getLogger(__name__)

PACKAGES = Path(__file__).resolve().parents[2]
ROOMS = (
    "vg2gt/rendering",
    "vg2gt/losses",
    "vg2gt/voxels",
    "vg2gt/visibility",
    "vg2gt/data/synthetic",
    "vg2gt/data/sources",
    "backends/sweep",
)
"""Folders whose kernels take constants and functions from files of the same folder and of ``SHARED`` only (a test
holds it)."""
SHARED = Path(__file__).with_name("compiled_math.py")
UNUSED_DAYS = 30
VARIABLE = "NUMBA_CACHE_DIR"


class _CollectorPaused(event.Listener):
    """No garbage is collected while numba compiles, for seconds at most.

    A compilation makes so many objects that Python would look through all that torch and Lightning have imported again
    and again: a fifth of the time. Compilations stand inside one another, under numba's one lock.
    """

    def __init__(self) -> None:
        self._depth = 0
        self._pause = False

    def on_start(self, event: event.Event) -> None:
        """Pauses the collector at the outermost compilation."""
        if self._depth == 0:
            self._pause = gc.isenabled()
            if self._pause:
                gc.disable()
        self._depth += 1

    def on_end(self, event: event.Event) -> None:
        """Lets it go on as it was."""
        self._depth -= 1
        if self._depth == 0 and self._pause:
            gc.enable()


event.register("numba:compile", _CollectorPaused())


def use_wide_vectors() -> None:
    """Lets numba use all 512 bits of a vector where the processor computes with them at full speed.

    LLVM takes half of them on Intel's processors, the first of which slowed down otherwise (Skylake to Cooper Lake,
    which have no VBMI2). It must be said before numba prepares its first function; what the user has chosen
    (``NUMBA_CPU_NAME``, ``NUMBA_CPU_FEATURES``) stays.
    """
    config: Any = numba.config  # pyright: ignore[reportPrivateImportUsage]
    if config.CPU_NAME is None and config.CPU_FEATURES is None and _cpu_features().get("avx512vbmi2"):
        config.CPU_FEATURES = codegen.get_host_cpu_features() + ",-prefer-256-bit"


def _cpu_features() -> Mapping[str, bool]:
    with suppress(RuntimeError):  # LLVM cannot tell everywhere
        return llvmlite.binding.get_host_cpu_features()
    return {}


use_wide_vectors()


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``numba.njit(**options)`` that is compiled once per machine and version of the sources.

    Compiled kernels are kept in the folder that the variable ``NUMBA_CACHE_DIR`` names, else in the user's cache
    folder, else in one of the user's own among temporary files; where none can be written to, every process compiles
    anew. A kernel that is made inside a function takes other kernels by their modules' names, not from that function:
    numba finds compiled code again by the values of the closure, and a kernel is another value in every process.
    """
    options["no_cfunc_wrapper"] = True  # nothing calls a kernel as a C function, and compiling that takes time

    def compile_later(function: Callable[..., Any]) -> Any:
        """The kernel, compiled when it is first called and kept in the folder of its sources' hash."""
        folder = _folder(_room(Path(function.__code__.co_filename)))
        if folder is None:
            return numba.njit(**options)(function)
        config: Any = numba.config  # pyright: ignore[reportPrivateImportUsage]
        chosen, config.CACHE_DIR = config.CACHE_DIR, str(folder)  # numba reads it while it decorates
        try:
            made: Any = numba.njit(**options)(function)
            made._cache = KernelCache(function)
        finally:
            config.CACHE_DIR = chosen
        return made

    return compile_later


def kernel_part(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """For functions that kernels call: compiled with them and kept within them, without an entry of their own.

    Called from Python such a function is interpreted.
    """
    return register_jitable(no_cfunc_wrapper=True, **options)


def _room(source: Path) -> Path:
    """The folder that a kernel of this file is made of."""
    rooms = [PACKAGES / room for room in ROOMS if source.resolve().is_relative_to(PACKAGES / room)]
    if not rooms:
        raise ValueError(f"{source}: kernels belong into {', '.join(ROOMS)}, whose files are hashed for the cache")
    return rooms[0]


@lru_cache
def _folder(room: Path) -> Path | None:
    """Where kernels of a room are kept; None where nothing can be written."""
    base = cache_folder()
    folder = base and _tried(base / f"{room.name}-{_digest(room)}")
    if base is None or folder is None:
        log.warning("compiled kernels cannot be kept, every start compiles them anew: name a folder by %s", VARIABLE)
        return None
    with suppress(OSError):
        os.utime(folder)
    _remove_unused(base)
    return folder


def _digest(room: Path) -> str:
    versions = f"{numba.__version__} {llvmlite.__version__} {platform.python_version()}"
    content = hashlib.sha256(versions.encode())
    for path in [Path(__file__), Path(compiled_files.__file__), SHARED, *sorted(room.rglob("*.py"))]:
        content.update(path.name.encode() + b"\0" + path.read_bytes())
    return content.hexdigest()[:16]


def compiled_mark() -> Path | None:
    """A folder that exists once a training's kernels were compiled on this kind of processor; None if nowhere."""
    base = cache_folder()
    parts = [llvmlite.binding.get_host_cpu_name(), *(_digest(PACKAGES / room) for room in ROOMS)]
    return base and base / f"compiled-{hashlib.sha256(' '.join(parts).encode()).hexdigest()[:16]}"


def cache_folder() -> Path | None:
    """Where this project keeps what it computed about a machine, compiled kernels above all; None if nowhere."""
    given = os.environ.get(VARIABLE)
    if given:
        return _tried(Path(given) / "vg2gt")
    with suppress(RuntimeError):  # a user without a home
        found = _tried(Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vg2gt" / "kernels")
        if found is not None:
            return found
    return _own_temporary_folder()


def _tried(folder: Path) -> Path | None:
    """The folder if files can be written to it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        return None


def _own_temporary_folder() -> Path | None:
    """A folder that nobody else can write to: what lies in it is executed."""
    if not hasattr(os, "getuid"):
        return None
    try:
        folder = Path(tempfile.gettempdir()) / f"vg2gt-kernels-{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError:
        return None
    own = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o077
    return _tried(folder) if own else None


def _remove_unused(base: Path) -> None:
    """Deletes kernels of versions that were not used for a month."""
    for folder in base.glob("*-" + "[0-9a-f]" * 16):
        with suppress(OSError):
            if time.time() - folder.stat().st_mtime > UNUSED_DAYS * 86400:
                shutil.rmtree(folder)
