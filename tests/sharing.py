"""Folders that are made once, whichever of the test processes needs them first."""

from collections.abc import Callable
from pathlib import Path

import pytest
from filelock import FileLock


def shared_folder(factory: pytest.TempPathFactory, name: str) -> Path:
    """A folder among the temporary files of this run of pytest, the same in all its processes."""
    base = factory.getbasetemp()
    base = base.parent if base.name.startswith("popen-gw") else base  # of one process of several
    folder = base / f"shared-{name}"
    folder.mkdir(exist_ok=True)
    return folder


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """A shared folder that the first process fills; the others wait for it, and try themselves if it fails."""
    folder = shared_folder(factory, name)
    done = folder.with_name(f"{folder.name}.done")
    with FileLock(f"{folder}.lock"):
        if not done.exists():
            make(folder)
            done.touch()
    return folder
