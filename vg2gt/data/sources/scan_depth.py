"""Depth images of a laser scan: its points splatted into a camera, what they hide removed. Done once and kept."""

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
from vg2gt.io.files import write_cached
from vg2gt.io.image_files import Size
from vg2gt.io.npz import load_npz
from vg2gt.io.ply_container import read_vertices
from vg2gt.kernels.compiled import kernel

VERSION = 1
"""Raise it when the same scan would give other depth: it is part of the cache's key."""


@dataclass(frozen=True)
class ScanDepth:
    """Depth images of scans, rendered when asked for the first time.

    Args:
        cache: folder for the rendered images; None: they are rendered whenever they are read.
        occlusion: points farther than this many times the nearest depth in the window around them are hidden by what is
            there, seen through between its points, and dropped.
        window: side of that window in pixels, odd; it must be larger than the gaps between a near surface's points.

    Raises:
        ValueError: if ``occlusion`` is below 1 or the window not a positive odd number.
    """

    cache: Path | None = None
    occlusion: float = 1.03
    window: int = 7
    _scans: dict[tuple[Path, float], NDArray[np.float32]] = field(default_factory=dict, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not self.occlusion >= 1:
            raise ValueError(f"occlusion must be at least 1 (a ratio of depths), got {self.occlusion}")
        if self.window < 1 or self.window % 2 == 0:
            raise ValueError(f"window must be a positive odd number of pixels, got {self.window}")

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
        stored = None if self.cache is None else self._path(scan, scene, world_to_camera, intrinsics, size, unit)
        if stored is not None and stored.is_file():
            try:
                depth = load_npz(stored, scene, ("depth",))["depth"]
                if depth.shape == tuple(size) and depth.dtype == np.float32:
                    return depth
            except DataError:
                pass  # a damaged copy is made again
        points = self._points(scan, scene, unit)
        depth = render_points(points, world_to_camera, intrinsics, size, self.occlusion, self.window)
        if stored is not None and self.cache is not None:
            buffer = io.BytesIO()
            np.savez_compressed(buffer, depth=depth)
            write_cached(stored, buffer.getvalue(), self.cache)
        return depth

    def _points(self, scan: Path, scene: str, unit: float) -> NDArray[np.float32]:
        if (scan, unit) not in self._scans:
            self._scans.clear()  # scans are large, and scenes come one after another
            self._scans[scan, unit] = read_points(scan, scene) * np.float32(unit)
        return self._scans[scan, unit]

    def _path(self, scan: Path, scene: str, pose: NDArray, intrinsics: NDArray, size: Size, unit: float) -> Path:
        assert self.cache is not None
        try:
            state = scan.stat()
        except OSError as error:
            raise DataError(f"cannot read {scan}, the scan of scene {scene}: {error}") from error
        file = (str(scan.resolve()), state.st_mtime_ns, state.st_size, unit)
        view = (pose.tolist(), intrinsics.tolist(), size)
        key = json.dumps([VERSION, file, view, self.occlusion, self.window])
        return self.cache / "scan-depth" / f"{hashlib.sha256(key.encode()).hexdigest()[:24]}.npz"


def read_points(path: Path, scene: str) -> NDArray[np.float32]:
    """Positions ``[N, 3]`` of a PLY file's vertices, those that are not finite left out.

    Raises:
        DataError: if the file is missing or damaged, or has no points.
    """
    with errors_name(scene):
        table = read_vertices(path)
    missing = [name for name in "xyz" if name not in (table.dtype.names or ())]
    if missing:
        raise DataError(f"the vertices in {path} of scene {scene} have no {', '.join(missing)}: it is no scan")
    with np.errstate(over="ignore", invalid="ignore"):
        points = np.stack([table[name].astype(np.float32) for name in "xyz"], -1)
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
    nearest = _splat(np.ascontiguousarray(points, np.float32), world_to_camera, intrinsics, *size)
    front = minimum_filter(nearest, window, mode="nearest")
    seen = np.isfinite(nearest) & (nearest <= front * np.float32(occlusion))
    return np.where(seen, nearest, np.float32(0))


@kernel(nogil=True)
def _splat(points, pose, intrinsics, height, width):
    depth = np.full((height, width), np.inf, np.float32)
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2] + 0.5, intrinsics[1, 2] + 0.5
    for i in range(len(points)):
        px, py, pz = points[i]
        z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
        if z < 1e-6:
            continue
        x = fx * (pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]) / z + cx
        y = fy * (pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]) / z + cy
        if 0 <= x < width and 0 <= y < height:
            row, column = int(y), int(x)
            depth[row, column] = min(depth[row, column], np.float32(z))
    return depth
