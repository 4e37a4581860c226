"""Depth images rendered from the points of a laser scan, without occluded points; cached."""

from __future__ import annotations

import hashlib
import io
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from vg2gt.data.base import DataError
from vg2gt.data.sources.parsing import errors_name
from vg2gt.io.arrays import load_npz
from vg2gt.io.files import write_cached
from vg2gt.io.image_files import Size

_VERSION = 2  # part of the cache key; increment it when the result changes
_CHUNK = 1 << 20  # points projected at a time


@dataclass(frozen=True)
class ScanDepth:
    """Depth images of scans, rendered on first use.

    Args:
        cache: folder for the rendered images; None renders on every read.
    """

    cache: Path | None = None
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
        """Returns the depth ``[H, W]`` of a scan in a view, 0 without a point.

        Args:
            scan: PLY file of points.
            scene: name of the scene, for messages.
            world_to_camera: pose of the view ``[4, 4]``, in the world frame of the scan.
            intrinsics: ``[3, 3]`` of the view, integer pixel centres.
            size: ``(height, width)`` of the view.
            unit: unit of the scan in units of the pose, such as 0.001 for millimetres and metres.

        Raises:
            DataError: if the scan is missing, damaged or empty.
        """
        with errors_name(scene):
            state = scan.stat()
        file = (str(scan.resolve()), state.st_mtime_ns, state.st_size, unit)
        key = json.dumps([_VERSION, file, (world_to_camera.tolist(), intrinsics.tolist(), size)])
        name = f"{hashlib.sha256(key.encode()).hexdigest()[:24]}.npz"
        stored = None if self.cache is None else self.cache / "scan-depth" / name
        if stored is not None and stored.is_file():
            try:
                return load_npz(stored, scene, ("depth",))["depth"]
            except DataError:
                pass  # damaged: render again
        if (scan, unit) not in self._scans:
            self._scans.clear()  # keep only one scan, as scans are large and scenes are read in sequence
            self._scans[scan, unit] = read_points(scan, scene) * np.float32(unit)
        depth = render_points(self._scans[scan, unit], world_to_camera, intrinsics, size)
        if stored is not None and self.cache is not None:
            buffer = io.BytesIO()
            np.savez_compressed(buffer, depth=depth)
            write_cached(stored, buffer.getvalue(), self.cache)
        return depth


def read_points(path: Path, scene: str) -> NDArray[np.float32]:
    """Reads the finite vertex positions ``[N, 3]`` of a PLY file.

    Raises:
        DataError: if the file is missing or damaged, or has no points.
    """
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            scan: Any = trimesh.load(path, file_type="ply", process=False)
            points = np.asarray(scan.vertices).astype(np.float32)
    except Exception as error:  # damaged files raise various errors
        raise DataError(f"cannot read the scan {path} of scene {scene}: {error}") from error
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
    """Renders the depth ``[H, W]`` of points ``[N, 3]``: the nearest one per pixel unless occluded, 0 without a point.

    Every point covers only the pixel it projects to, so that depth comes from a point less than 0.71 pixels away. A
    point is occluded if its depth exceeds ``occlusion`` times the smallest depth in the window of ``window`` pixels (an
    odd number, more than the gaps between the points of a near surface) around it.
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
