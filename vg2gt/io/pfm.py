"""Portable float maps: depth as MVSNet's tools store it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vg2gt.io.errors import DataError
from vg2gt.io.files import regular
from vg2gt.io.image_files import Size, check_size

_HEADER = re.compile(rb"(P[fF])\s+(\d{1,6})\s+(\d{1,6})\s+([-+0-9.eE]{1,20})\s")


def read_pfm(path: Path, scene: str, size: Size | None = None) -> NDArray[np.float32]:
    """Reads a one-channel float image ``[H, W]``, its first row at the top (the file has the bottom row first).

    Args:
        path: the file.
        scene: the scene it belongs to, for messages.
        size: the ``(height, width)`` it must have; None: any.

    Raises:
        DataError: if the file is missing, truncated or too long, not such an image, or of another size.
    """
    try:
        content = regular(path).read_bytes()
    except OSError as error:
        raise DataError(f"cannot read {path} of scene {scene}: {error}") from error
    header = _HEADER.match(content[:64])
    scale = _number(header[4]) if header else 0.0
    if header is None or header[1] != b"Pf" or scale == 0:
        raise DataError(f"{path} of scene {scene} is not a one-channel PFM image: it begins with {content[:24]!r}")
    width, height = int(header[2]), int(header[3])
    values = content[header.end() :]
    if len(values) != 4 * width * height or not values:
        raise DataError(
            f"{path} of scene {scene} is damaged: {width}x{height} pixels take {4 * width * height} bytes, it has "
            f"{len(values)}"
        )
    check_size(path, scene, (height, width), size)
    # The sign of the scale is the byte order: negative is little-endian.
    pixels = np.frombuffer(values, "<f4" if scale < 0 else ">f4").reshape(height, width)
    return pixels[::-1].astype(np.float32)


def _number(text: bytes) -> float:
    try:
        number = float(text)
    except ValueError:
        return 0.0
    return number if np.isfinite(number) else 0.0
