"""Depth in OpenEXR files, as Record3D exports it; reading them takes the extra ``phone``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vg2gt.io.errors import FormatError
from vg2gt.io.files import regular


def read_exr(path: Path) -> NDArray[np.float32]:
    """Reads the only channel, or the first by name, of an EXR image ``[H, W]`` in the file's unit.

    Raises:
        FormatError: if the file is damaged or has no channel of floats.
        ImportError: if the package ``OpenEXR`` is not installed.
        OSError: if it cannot be opened.
    """
    try:
        import OpenEXR  # pyright: ignore[reportMissingImports]: optional
    except ImportError as error:
        raise ImportError(f"{path.name} is read with OpenEXR: pip install 'vg2gt[phone]'") from error
    try:
        with OpenEXR.File(str(regular(path)), separate_channels=True) as file:
            channels = {name: channel.pixels for name, channel in file.channels().items()}
    except (RuntimeError, ValueError) as error:  # what its C++ side makes of damaged bytes
        raise FormatError(f"{path}: not an OpenEXR image ({error}); the file is truncated or damaged") from error
    floats = [pixels for _, pixels in sorted(channels.items()) if pixels.ndim == 2 and pixels.dtype.kind == "f"]
    if not floats:
        raise FormatError(f"{path}: expected a channel of floats, found {', '.join(channels) or 'none'}")
    return np.asarray(floats[0], np.float32)
