"""NumPy archives from anywhere: no pickles."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from vg2gt.io.errors import DataError, FormatError
from vg2gt.io.files import regular


def read_npz(file: str | Path | BinaryIO, names: Sequence[str]) -> dict[str, NDArray]:
    """Reads named arrays of an ``.npz`` archive without executing anything in it.

    Args:
        file: a path, or an open file.
        names: the arrays to read; others are left alone.

    Raises:
        KeyError: naming an array that is not there.
        FormatError: if the file is no archive, damaged, or holds Python objects.
        OSError: if it cannot be opened.
    """
    try:
        if isinstance(file, (str, Path)):
            regular(file)
        with np.load(file, allow_pickle=False) as stored:
            if not isinstance(stored, np.lib.npyio.NpzFile):
                raise FormatError("it is a single array, not an archive")
            return {name: stored[name] for name in names}
    except (OSError, KeyError, FormatError):
        raise
    except Exception as error:  # damage raises whatever zipfile, zlib and the header's parser raise; sizes MemoryError
        raise FormatError(f"no readable archive of plain arrays: {error or type(error).__name__}") from error


def npz_names(path: Path) -> tuple[str, ...]:
    """Names of the arrays in an ``.npz`` file.

    Raises:
        FormatError: if it is no archive.
    """
    try:
        with zipfile.ZipFile(regular(path)) as archive:
            return tuple(name.removesuffix(".npy") for name in archive.namelist())
    except zipfile.BadZipFile as error:
        raise FormatError(f"no readable archive of plain arrays: {error}") from error


def load_npz(path: Path, scene: str, names: Sequence[str]) -> dict[str, NDArray]:
    """Reads named arrays of an ``.npz`` file without executing anything in it.

    Raises:
        DataError: if the file is missing or damaged, or lacks one of the arrays.
    """
    try:
        return read_npz(path, names)
    except KeyError as error:
        raise DataError(f"{path} of scene {scene} has no array {error}; expected {', '.join(names)}") from error
    except (OSError, FormatError) as error:
        raise DataError(f"cannot read {path} of scene {scene}: {error}") from error
