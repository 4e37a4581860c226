"""Checks shared by the JSON formats of cameras; violations raise ``FormatError``, naming the place in the file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vg2gt.io.errors import FormatError

MAX_SIZE = 1 << 16  # pixels along an image's side


class Fields:
    """The fields of one JSON object; every error (``FormatError``) names the place and the field.

    Args:
        place: prefix of field names in messages, such as ``cameras.json: [1].``.
        content: the parsed object.
    """

    def __init__(self, place: str, content: Any) -> None:
        if not isinstance(content, dict):
            raise FormatError(f"{place.rstrip('.: ')} should be an object, got {short(content)}")
        self.place, self.content = place, content

    def wrong(self, name: str, expected: str) -> FormatError:
        """Returns the error for a field that is missing or not as expected."""
        return FormatError(f"{self.place}{name} is {short(self.content.get(name))}, expected {expected}")

    def get(self, name: str, kind: type, expected: str, required: bool = False) -> Any:
        """Returns a field of type ``kind``; None if it is missing and not ``required``."""
        value = self.content.get(name)
        if not isinstance(value, kind) and (required or value is not None):
            raise self.wrong(name, expected)
        return value

    def number(self, name: str, low: float = -math.inf, high: float = math.inf) -> float | None:
        """Returns a finite number strictly between ``low`` and ``high``; None if it is missing."""
        value = self.content.get(name)
        if value is None:
            return None
        if type(value) not in (int, float) or abs(value) > 1e300 or not low < value < high:
            limits = "" if low == -math.inf else f" greater than {low:g}" + (f" and below {high:g}" * (high < math.inf))
            raise self.wrong(name, f"a finite number{limits}")
        return float(value)

    def pixels(self, name: str, required: bool = False) -> int | None:
        """Returns a whole number of pixels; None if it is missing and not ``required``."""
        value = self.number(name, 0, MAX_SIZE)
        if value is None and not required:
            return None
        if value is None or value != round(value):
            raise self.wrong(name, "a whole number of pixels")
        return round(value)

    def matrix(self, name: str, rows: Sequence[int], columns: int) -> NDArray[np.float64]:
        """Returns a matrix whose number of rows is one of ``rows``; its values may be NaN or infinite."""
        value = self.content.get(name)
        lists = value if isinstance(value, list) and len(value) in rows else [None]
        try:
            if all(isinstance(row, list) and all(type(number) in (int, float) for number in row) for row in lists):
                return np.array(lists, np.float64).reshape(len(lists), columns)
        except (ValueError, OverflowError):
            pass
        raise self.wrong(name, f"{' or '.join(map(str, rows))} rows of {columns} finite numbers")


def check_rigid(place: str, matrix: NDArray[np.float64], tolerance: float) -> None:
    """Checks that a finite ``[4, 4]`` matrix is a rotation, orthonormal within ``tolerance``, and a translation."""
    rotation = matrix[:3, :3]
    error = np.abs(rotation.T @ rotation - np.eye(3)).max() if np.abs(rotation).max() < 2 else math.inf
    if error > tolerance or np.linalg.det(rotation) < 0 or np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise FormatError(
            f"{place} is not a rotation and a translation (R'R differs from the identity by {error:.2g}); remove "
            "scale, shear and mirroring"
        )


def short(value: Any) -> str:
    """Formats a value for a message, in at most 80 characters."""
    text = type(value).__name__ if isinstance(value, dict | list) else "missing" if value is None else repr(value)
    return text if len(text) <= 80 else text[:77] + "..."
