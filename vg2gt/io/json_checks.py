"""What the JSON formats of cameras check alike."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vg2gt.io.errors import FormatError
from vg2gt.io.files import read_json

MAX_SIZE = 1 << 20  # pixels along an image's side


def load_json(path: Path, content: bytes | None = None) -> Any:
    """Reads a file, or what was read of it.

    Raises:
        FormatError: if it is not JSON, naming the file.
    """
    try:
        return read_json(path) if content is None else json.loads(content)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{path}: not valid JSON ({error}); the file is truncated or damaged") from error


def check_rigid(place: str, matrix: NDArray[np.float64], tolerance: float) -> None:
    """Checks that a finite ``[4, 4]`` matrix is a rotation, orthonormal to the tolerance, and a translation.

    Raises:
        FormatError: if it is not, naming the place.
    """
    rotation = matrix[:3, :3]
    error = np.abs(rotation.T @ rotation - np.eye(3)).max() if np.abs(rotation).max() < 2 else math.inf
    if error > tolerance or np.linalg.det(rotation) < 0 or np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise FormatError(
            f"{place} is not a rotation and a translation (R'R differs from the identity by {error:.2g}); remove "
            "scale, shear and mirroring"
        )


def short(value: Any) -> str:
    """A value in a message, 80 characters at most."""
    text = type(value).__name__ if isinstance(value, dict | list) else "missing" if value is None else repr(value)
    return text if len(text) <= 80 else text[:77] + "..."
