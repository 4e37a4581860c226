"""Depth images of a laser scan: its points splatted into a camera, hidden ones removed. Done once and kept."""

from __future__ import annotations

import hashlib
import io
import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from vg2gt.data.base import DataError
from vg2gt.data.sources.parsing import errors_name
from vg2gt.io.arrays import load_npz
from vg2gt.io.files import write_cached
from vg2gt.io.image_files import Size
from vg2gt.io.ply import read_point_ply

VERSION = 1
"""Raise it when the same scan would give other depth: it is part of the cache's key."""
_CHUNK = 1 << 20  # points projected at once


@dataclass(frozen=True)
class ScanDepth:
    """Depth images of scans, rendered when asked for the first time.

    Args:
        cache: folder for the rendered images; None: they are rendered whenever they are read.
        occlusion: a point farther than this many times the nearest depth in the window around it is hidden, and
            dropped.
        window: side of that window in pixels, odd; larger than the gaps between a near surface's points.
    """

    cache: Path | None = None
    occlusion: float = 1.03
    window: int = 7
    _scans: dict[tuple[Path, float], NDArray[np.float32]] = field(default_factory=dict, repr=False, compare=False)

    def read(
        self,
        scan: Path,
        scene: str,
        world_to_camera: NDArray[np.float64],
        intrinsics: NDArray[np.float64],
        size: Size,
        unit: float = 1.0,
    ) -> NDArray[np.float32]:
        """Depth ``[H, W]`` of a scan in a view, 0 where no point is.

        Args:
            scan: a PLY file of points.
            scene: the scene it belongs to, for messages.
            world_to_camera: ``[4, 4]`` of the view; the world is the scan's.
            intrinsics: ``[3, 3]`` of the view, integer pixel centres.
            size: ``(height, width)`` of the view.
            unit: the scan's unit in that of the pose, such as 0.001 for millimetres and metres.

        Raises:
            DataError: if the scan is missing, damaged or empty.
        """
        with errors_name(scene):
            state = scan.stat()
        file = (str(scan.resolve()), state.st_mtime_ns, state.st_size, unit)
        view = (world_to_camera.tolist(), intrinsics.tolist(), size)
        key = json.dumps([VERSION, file, view, self.occlusion, self.window])
        name = f"{hashlib.sha256(key.encode()).hexdigest()[:24]}.npz"
        stored = None if self.cache is None else self.cache / "scan-depth" / name
        if stored is not None and stored.is_file():
            try:
                return load_npz(stored, scene, ("depth",))["depth"]
            except DataError:
                pass  # a damaged copy is made again
        if (scan, unit) not in self._scans:
            self._scans.clear()  # scans are large, and scenes come one after another
            self._scans[scan, unit] = read_points(scan, scene) * np.float32(unit)
        points = self._scans[scan, unit]
        depth = render_points(points, world_to_camera, intrinsics, size, self.occlusion, self.window)
        if stored is not None and self.cache is not None:
            buffer = io.BytesIO()
            np.savez_compressed(buffer, depth=depth)
            write_cached(stored, buffer.getvalue(), self.cache)
        return depth


def read_points(path: Path, scene: str) -> NDArray[np.float32]:
    """Finite positions ``[N, 3]`` of a PLY file's vertices.

    Raises:
        DataError: if the file is missing or damaged, or has no points.
    """
    with errors_name(scene), np.errstate(over="ignore", invalid="ignore"):
        points = read_point_ply(path).positions.astype(np.float32)
    points = points[np.isfinite(points).all(1)]
    if not len(points):
        raise DataError(f"the scan {path} of scene {scene} has no points")
    return points


def render_points(
    points: NDArray[np.float32],
    world_to_camera: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    size: Size,
    occlusion: float = 1.03,
    window: int = 7,
) -> NDArray[np.float32]:
    """Depth ``[H, W]`` of points ``[N, 3]`` in a view: the nearest in each pixel, hidden ones dropped, 0 where none is.

    Every point fills the one pixel it falls in, so that depth is that of a point less than 0.71 pixels away.
    """
    height, width = size
    nearest = np.full(height * width, np.inf, np.float32)
    for part in np.array_split(points, len(points) // _CHUNK + 1):
        local = part @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
        local = local[local[:, 2] > 1e-6]
        z = local[:, 2]
        x, y = ((local / z[:, None]) @ intrinsics[:2].T + 0.5).T
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        pixel = y[inside].astype(np.int64) * width + x[inside].astype(np.int64)
        np.minimum.at(nearest, pixel, z[inside].astype(np.float32))
    nearest = nearest.reshape(height, width)
    front = minimum_filter(nearest, window, mode="nearest")
    return np.where(np.isfinite(nearest) & (nearest <= front * np.float32(occlusion)), nearest, np.float32(0))
