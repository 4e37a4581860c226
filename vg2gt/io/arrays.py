"""NumPy files whose shapes are checked before anything is made of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vg2gt.io.errors import DataError
from vg2gt.io.image_files import Size, check_size
from vg2gt.io.npz import load_npz


def load_matrices(
    path: Path, scene: str, shapes: Mapping[str, tuple[int | None, ...]]
) -> dict[str, NDArray[np.float64]]:
    """Reads named numeric arrays of an ``.npz`` file.

    Args:
        path: the file.
        scene: the scene it belongs to, for messages.
        shapes: the shape that each array must have; None: any length.

    Raises:
        DataError: if the file is missing or damaged, lacks an array, or one has another shape or holds no numbers.
    """
    arrays = load_npz(path, scene, tuple(shapes))
    for name, shape in shapes.items():
        array = arrays[name]
        fits = array.ndim == len(shape) and all(
            size in (None, length) for size, length in zip(shape, array.shape, strict=True)
        )
        if not fits or array.dtype.kind not in "fiu":
            expected = "x".join("N" if size is None else str(size) for size in shape)
            raise DataError(
                f"{name} in {path} of scene {scene} must hold {expected} numbers, not {array.dtype} of shape "
                f"{array.shape}"
            )
    return {name: arrays[name].astype(np.float64) for name in shapes}


def npy_size(path: Path, scene: str) -> Size:
    """The ``(height, width)`` of a float image in an ``.npy`` file, without reading its values.

    Raises:
        DataError: if the file is missing or damaged, or no image of floats.
    """
    return _map_npy(path, scene).shape


def load_npy(path: Path, scene: str, size: Size) -> NDArray[np.float32]:
    """Reads a float image ``[h, w]`` of an ``.npy`` file.

    Raises:
        DataError: if the file is missing or damaged, no image of floats, or of another size.
    """
    mapped = _map_npy(path, scene)
    check_size(path, scene, mapped.shape, size)
    return np.asarray(mapped, dtype=np.float32)


def _map_npy(path: Path, scene: str) -> NDArray[np.floating]:
    """Maps the file, so that a damaged header cannot ask for more memory than the file has bytes."""
    try:
        mapped = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # a damaged header raises whatever its parser, tokenizer and mmap raise
        raise DataError(f"cannot read {path} of scene {scene}: {error}; restore it or remove the frame") from error
    if not isinstance(mapped, np.ndarray) or mapped.ndim != 2 or mapped.dtype.kind != "f":
        raise DataError(f"{path} of scene {scene} is not a depth image: expected a two-dimensional array of floats")
    return mapped
