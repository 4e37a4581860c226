"""The C library's allocator is replaced before a command imports torch."""

from __future__ import annotations

import os
import sys
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

CHOICE = "VG2GT_ALLOCATOR"
_AGAIN = "VG2GT_STARTED_AGAIN"  # names the variables that are for the start alone
_PRELOAD = "LD_PRELOAD"
_OPTIONS = {
    "MIMALLOC_ALLOW_THP": "0",  # large pages take more memory and save no time
    # ms until freed pages go back, 1000 by default: after 10,000 a large step fetches five times as many again
    "MIMALLOC_PURGE_DELAY": "60000",
}
_KEPT_CODE = {
    "ONEDNN_PRIMITIVE_CACHE_CAPACITY": "256"  # shapes, 1024 by default; numbers of voxels seldom come twice
}


def start_with_mimalloc() -> None:
    """Starts the present command again, in the same process, with mimalloc in place of the C library's allocator.

    What a step allocates differs with the voxels of its scene. glibc finds no place for the next step's blocks among
    those of the last one, so memory grows and every step fetches pages anew (docs/reliability.md has both measured).
    Only for a process that was started for its command: what it did before this call is done a second time. Nothing is
    done on systems other than Linux, in a notebook or another interactive session, where torch is imported already,
    under a debugger or profiler, where the environment preloads a library of its own, and with
    ``VG2GT_ALLOCATOR=system``. Programs that the command starts do not inherit it.

    Raises:
        SystemExit: if ``VG2GT_ALLOCATOR`` is neither ``mimalloc`` nor ``system``.
    """
    if _AGAIN in os.environ:
        for name in os.environ.pop(_AGAIN).split(","):
            os.environ.pop(name, None)
        return
    if "torch" in sys.modules or not sys.executable or _watched() or not _started_for_this():
        return
    try:
        settings = mimalloc_environment()
    except ValueError as error:
        sys.exit(f"{type(error).__name__}: {error}")
    if not settings:
        return
    sys.stdout.flush()
    sys.stderr.flush()
    environment = {**os.environ, **settings, _AGAIN: ",".join(settings.keys() - _KEPT_CODE.keys())}
    os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], environment)


def _watched() -> bool:
    return sys.gettrace() is not None or sys.getprofile() is not None


def _started_for_this() -> bool:
    """Whether the process is that of a command: not a session or a script that runs the command's file."""
    interactive = hasattr(sys, "ps1") or "IPython" in sys.modules
    read = not sys.argv[0] or sys.argv[0] == "-"  # the program came through a pipe, and is gone
    return not interactive and not read and bool({sys.argv[0], "-m"} & set(sys.orig_argv))


def mimalloc_environment() -> dict[str, str]:
    """Variables with which a Python process runs on mimalloc; none where it should not or cannot.

    Raises:
        ValueError: if ``VG2GT_ALLOCATOR`` is neither ``mimalloc`` nor ``system``.
    """
    choice = os.environ.get(CHOICE, "mimalloc")
    if choice not in ("mimalloc", "system"):
        raise ValueError(f"{CHOICE}={choice} is unknown: choose mimalloc or system")
    library = _library() if choice == "mimalloc" and not os.environ.get(_PRELOAD) else None
    if library is None:
        return {}
    options = {**_OPTIONS, **_KEPT_CODE}
    return {_PRELOAD: str(library), **{name: value for name, value in options.items() if name not in os.environ}}


def _library() -> Path | None:
    """The shared library that the package ``cmeel-mimalloc`` has installed, if its path can be preloaded."""
    if sys.platform != "linux":
        return None
    try:
        found = [file for file in files("cmeel-mimalloc") or () if file.name == "libmimalloc.so"]
    except PackageNotFoundError:
        return None
    paths = [Path(str(file.locate())).resolve() for file in found]
    separators = set(" :")  # of the loader's list, which knows no quotes
    return next((path for path in paths if path.is_file() and not separators & set(str(path))), None)
