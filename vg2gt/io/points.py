"""Coloured points as PLY, and what files of points have in common."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vg2gt.io.files import write_bytes

_MIDDLE = 0.9  # share of the points that defines a scene's extent, without far outliers


def checked_points(positions: ArrayLike, colors: ArrayLike | None) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Returns positions ``[N, 3]`` and colours ``[N, 3]`` as arrays; no colours are mid grey.

    Raises:
        ValueError: if shapes or types are wrong, or a position is not finite.
    """
    xyz = np.asarray(positions, np.float64)
    rgb = np.full(xyz.shape, 128, np.uint8) if colors is None else np.asarray(colors)
    if xyz.ndim != 2 or xyz.shape[1] != 3 or rgb.shape != xyz.shape or rgb.dtype != np.uint8:
        raise ValueError(
            f"positions must be [N, 3] and colors uint8 [N, 3], got {list(xyz.shape)} and {rgb.dtype} {list(rgb.shape)}"
        )
    if not np.isfinite(xyz).all():
        raise ValueError("positions must be finite")
    return xyz, rgb


def write_point_ply(path: str | Path, positions: ArrayLike, colors: ArrayLike | None = None) -> Path:
    """Writes points as binary PLY, float32 ``x y z`` and uchar ``red green blue alpha``, atomically.

    Args:
        path: the file.
        positions: ``[N, 3]``.
        colors: ``[N, 3]`` uint8; None: mid grey.

    Raises:
        ValueError: if shapes or types are wrong, or a position is not finite.
    """
    import trimesh  # imported here, because it takes a second

    content = trimesh.PointCloud(*checked_points(positions, colors)).export(file_type="ply")
    assert isinstance(content, bytes)
    return write_bytes(path, content)


def scene_extent(xyz: NDArray[np.float64], centers: NDArray[np.float64]) -> float:
    """Diagonal of the box around camera centres ``[V, 3]`` and the central points of ``[N, 3]``; 1 if it is 0."""
    tail = (1 - _MIDDLE) / 2
    middle = np.quantile(xyz, [tail, 1 - tail], axis=0) if len(xyz) else centers[:1]
    corners = np.concatenate((middle, centers))
    return float(np.linalg.norm(corners.max(0) - corners.min(0))) or 1.0
