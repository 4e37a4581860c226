"""Reading of untrusted NumPy files: pickles are refused, and shapes are checked first.

Functions that take a scene raise ``DataError``, naming file and scene, if a file is missing, damaged or has the wrong
shape.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from vg2gt.io.errors import DataError, FormatError
from vg2gt.io.files import regular
from vg2gt.io.image_files import Size, check_size


def read_npz(file: str | Path | BinaryIO, names: Sequence[str], optional: Sequence[str] = ()) -> dict[str, NDArray]:
    """Reads named arrays of an ``.npz`` archive without executing anything in it.

    Args:
        file: a path, or an open file.
        names: names of the arrays to read.
        optional: names of arrays to read if the archive has them.

    Raises:
        KeyError: if an array is missing, naming it.
        FormatError: if the file is not an archive, is damaged, or holds Python objects.
        OSError: if it cannot be opened.
    """
    try:
        if isinstance(file, (str, Path)):
            regular(file)
        with np.load(file, allow_pickle=False) as stored:
            if not isinstance(stored, np.lib.npyio.NpzFile):
                raise FormatError("it is a single array, not an archive")
            return {name: stored[name] for name in (*names, *(name for name in optional if name in stored.files))}
    except (OSError, KeyError, FormatError):
        raise
    except Exception as error:  # damaged files raise various errors of zipfile, zlib and parser, or MemoryError
        raise FormatError(f"not a readable archive of plain arrays: {error or type(error).__name__}") from error


def load_npz(path: Path, scene: str, names: Sequence[str]) -> dict[str, NDArray]:
    """Reads named arrays of an ``.npz`` file without executing anything in it."""
    try:
        return read_npz(path, names)
    except KeyError as error:
        raise DataError(f"{path} of scene {scene} has no array {error}; expected {', '.join(names)}") from error
    except (OSError, FormatError) as error:
        raise DataError(f"cannot read {path} of scene {scene}: {error}") from error


def load_matrices(
    path: Path, scene: str, shapes: Mapping[str, tuple[int | None, ...]]
) -> dict[str, NDArray[np.float64]]:
    """Reads named numeric arrays of an ``.npz`` file.

    Args:
        path: the file.
        scene: the scene it belongs to, for messages.
        shapes: required shape of each array; None: any length.
    """
    arrays = load_npz(path, scene, tuple(shapes))
    for name, shape in shapes.items():
        array = arrays[name]
        fits = array.ndim == len(shape) and all(
            size in (None, length) for size, length in zip(shape, array.shape, strict=True)
        )
        if not fits or array.dtype.kind not in "fiu":
            expected = "x".join("N" if size is None else str(size) for size in shape)
            found = f"{array.dtype} of shape {array.shape}"
            raise DataError(f"{name} in {path} of scene {scene} must hold {expected} numbers, not {found}")
    return {name: arrays[name].astype(np.float64) for name in shapes}


def npy_size(path: Path, scene: str) -> Size:
    """Returns the ``(height, width)`` of a float image in an ``.npy`` file without reading its values."""
    return _map_npy(path, scene).shape


def load_npy(path: Path, scene: str, size: Size) -> NDArray[np.float32]:
    """Reads a float image ``[H, W]`` from an ``.npy`` file."""
    mapped = _map_npy(path, scene)
    check_size(path, scene, mapped.shape, size)
    return np.asarray(mapped, dtype=np.float32)


def _map_npy(path: Path, scene: str) -> NDArray[np.floating]:
    """Memory-maps the file, so that a damaged header cannot allocate more memory than the file's size."""
    try:
        mapped = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # damaged headers raise various errors of parser, tokenizer and mmap
        raise DataError(f"cannot read {path} of scene {scene}: {error}; restore it or remove the frame") from error
    if not isinstance(mapped, np.ndarray) or mapped.ndim != 2 or mapped.dtype.kind != "f":
        raise DataError(f"{path} of scene {scene} is not a depth image: expected a two-dimensional array of floats")
    return mapped
