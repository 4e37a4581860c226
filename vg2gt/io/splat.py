"""The ``.splat`` format of the first web viewers: 32 bytes per Gaussian, no header.

Float32 position, float32 standard deviations, 8-bit red green blue and opacity, 8-bit wxyz. Losses compared with a PLY
file: view-dependent colour, colours outside [0, 1], and precision of colour and opacity (1/510) and of rotation (1/256
per component, about half a degree).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vg2gt.geometry.spherical_harmonics import DC
from vg2gt.io.errors import FormatError
from vg2gt.io.files import regular, write_bytes
from vg2gt.io.gaussian_arrays import GaussianArrays, to_arrays, to_gaussians
from vg2gt.types import Gaussians

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def write_splat(path: str | Path, gaussians: Gaussians) -> Path:
    """Writes one scene's Gaussians in order, atomically; the module lists the losses.

    Raises:
        ValueError: if there is more than one scene or a value cannot be written.
    """
    arrays = to_arrays(gaussians)
    rgba = np.concatenate((0.5 + DC * arrays.sh[:, 0], arrays.opacities[:, None]), 1)
    length = np.linalg.norm(arrays.quats, axis=-1, keepdims=True)
    if (length == 0).any():
        raise ValueError("quats must have nonzero norm")
    table = np.empty(len(rgba), _ROW)
    table["mean"], table["scale"] = arrays.means, arrays.scales
    table["rgba"] = np.rint(rgba.clip(0, 1) * 255)
    table["quat"] = np.rint(arrays.quats / length * 128 + 128).clip(0, 255)
    return write_bytes(path, table.tobytes())


def read_splat(path: str | Path) -> Gaussians:
    """Reads a ``.splat`` file.

    Most damage cannot be detected in this format. Rows with values that are not finite or a zero quaternion are dropped
    with a warning.

    Returns:
        The Gaussians as scene 0, float32, colours of degree 0.

    Raises:
        FormatError: if the length is not a multiple of 32 bytes or a standard deviation is negative.
    """
    path = Path(path)
    data = regular(path).read_bytes()
    if len(data) % _ROW.itemsize:
        raise FormatError(
            f"{path}: {len(data)} bytes are not a multiple of {_ROW.itemsize}; the file is truncated or not a .splat"
        )
    table = np.frombuffer(data, _ROW)
    with np.errstate(invalid="ignore"):  # signalling NaNs of damaged files become quiet NaNs
        means, scales = table["mean"].astype(np.float64), table["scale"].astype(np.float64)
    negative = np.flatnonzero((scales < 0).any(-1))
    if len(negative):
        raise FormatError(
            f"{path}, byte {negative[0] * _ROW.itemsize}: scales {scales[negative[0]].tolist()} are negative; the file "
            "is damaged or not a .splat"
        )
    rgba = table["rgba"] / 255.0
    arrays = GaussianArrays(
        means,
        (table["quat"] - 128.0) / 128,
        scales,
        rgba[:, 3],
        ((rgba[:, :3] - 0.5) / DC)[:, None],
    )
    return to_gaussians(path, arrays)
