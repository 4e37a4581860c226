"""Tanks and Temples: images with the benchmark's reference poses, and depth rendered from its laser scans."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter
from typing_extensions import Unpack

from vg2gt.data.base import DataError
from vg2gt.data.sources.colmap_model import model_folder_of
from vg2gt.data.sources.files import FileSource, HoldoutOptions
from vg2gt.data.sources.index import SceneIndex, make_index
from vg2gt.data.sources.parsing import errors_name, four_intrinsics, numbered, pinhole, read_matrix, read_text_lines
from vg2gt.data.sources.undistortion import is_pinhole, posed_image, size_on_disk
from vg2gt.io import colmap_images, read_colmap
from vg2gt.io.arrays import load_npz
from vg2gt.io.colmap import Camera
from vg2gt.io.files import write_cached
from vg2gt.io.image_files import Size

_VERSION = 2  # part of the cache key; increment it when the rendered depth changes
_CHUNK = 1 << 20  # points projected at a time
_LOG = "_COLMAP_SfM.log"


class TanksAndTemples(FileSource):
    """Scenes ``S`` with ``S_COLMAP_SfM.log``, ``S_trans.txt``, ``S.ply`` and images in ``images/`` or next to them.

    The log has a camera-to-world pose for each image, in the order of the image names and in the arbitrary unit of
    structure from motion. ``S_trans.txt`` transforms its world to that of the scan, in metres. Images that the log
    marks as not registered (second number -1) are left out and counted. The crop volume ``S.json`` is not needed.

    The benchmark has no calibration. Intrinsics come from ``intrinsics``, or from an undistorted COLMAP model of the
    same images in ``sparse/0`` or ``sparse`` (its poses are not used). The benchmark recommends a focal length of 0.7
    times the image width, but only as an initial guess; refined focal lengths are near 0.6.

    Args:
        root: a scene, a folder of scenes, or a list of these.
        intrinsics: (fx, fy, cx, cy) in pixels of the images, integer pixel centres; null uses the COLMAP model.
        depth: ``scan`` renders depth from ``S.ply`` and caches it in ``depth_cache``; null for no depth.
        depth_cache: folder of the rendered images.
        shared: see ``FileSource``.
    """

    layout = f"scenes S with S{_LOG}, S_trans.txt and images, there or one folder deeper"
    levels = 1
    index_options = ("intrinsics", "has_depth")

    def __init__(
        self,
        root: str | Sequence[str] | None,
        intrinsics: Sequence[float] | None = None,
        depth: str | None = "scan",
        depth_cache: str = "~/.cache/vg2gt",
        **shared: Unpack[HoldoutOptions],
    ) -> None:
        if depth not in (None, "scan"):
            raise ValueError(f"depth must be scan or null (none), got {depth!r}")
        self.intrinsics = four_intrinsics(intrinsics)
        self.has_depth = depth is not None
        self.depth_cache = Path(depth_cache).expanduser()
        super().__init__(root, **shared)

    def is_scene(self, folder: Path) -> bool:
        """Returns whether a folder has a trajectory."""
        return _log_file(folder) is not None

    def watched(self, scene: str, folder: Path) -> Sequence[Path | None]:
        """Returns the folder of the scene and of its COLMAP model."""
        return folder, model_folder_of(folder)

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Reads log, transform and intrinsics."""
        log_file = _log_file(folder)
        if log_file is None:
            raise DataError(f"scene {scene} has no file *{_LOG} in {folder}")
        name = log_file.name[: -len(_LOG)]
        color = numbered(folder / "images" if (folder / "images").is_dir() else folder, scene)
        if not color:
            raise DataError(f"scene {scene} has no images in {folder / 'images'} or {folder}")
        poses = _read_log(log_file, scene)
        if len(poses) != len(color):
            raise DataError(
                f"{log_file} of scene {scene} has {len(poses)} poses for {len(color)} images; they are matched by "
                "order, so all images of the benchmark are required"
            )
        to_scan = _read_similarity(folder / f"{name}_trans.txt", scene)
        scan = folder / f"{name}.ply"
        if self.has_depth and not scan.is_file():
            raise DataError(f"scene {scene} has no scan {scan}: add it, or set data.depth=null")
        registered = {i: pose for i, pose in zip(color, poses, strict=True) if pose is not None}
        intrinsics = self._intrinsics(scene, folder, color)
        to_world = {i: moved(to_scan, pose) for i, pose in registered.items() if i in intrinsics}
        depth = dict.fromkeys(color, scan) if self.has_depth else None
        return make_index(scene, folder, color, depth, to_world, intrinsics)

    def read_depth(self, index: SceneIndex, row: int, size: Size) -> NDArray[np.float32]:
        """Renders depth from the scan, or reads it from the cache."""
        scan, pose, matrix = index.depth[row], index.world_to_camera[row], index.intrinsics[row]
        with errors_name(index.name):
            state = scan.stat()
        file = (str(scan.resolve()), state.st_mtime_ns, state.st_size)
        key = json.dumps([_VERSION, file, (pose.tolist(), matrix.tolist(), size)])
        stored = self.depth_cache / "scan-depth" / f"{hashlib.sha256(key.encode()).hexdigest()[:24]}.npz"
        if stored.is_file():
            with suppress(DataError):  # damaged: render again
                return load_npz(stored, index.name, ("depth",))["depth"]
        depth = render_points(read_points(scan, index.name), pose, matrix, size)
        buffer = io.BytesIO()
        np.savez_compressed(buffer, depth=depth)
        write_cached(stored, buffer.getvalue(), self.depth_cache)
        return depth

    def _intrinsics(self, scene: str, folder: Path, color: Mapping[int, Path]) -> dict[int, NDArray[np.float64]]:
        if self.intrinsics is not None:
            return dict.fromkeys(color, pinhole(*self.intrinsics))
        model_folder = model_folder_of(folder)
        if model_folder is None:
            raise DataError(
                f"scene {scene} in {folder} has no intrinsics: add an undistorted COLMAP model of the images as "
                "sparse/, or set data.intrinsics=[fx,fy,cx,cy]"
            )
        with errors_name(scene):
            model = read_colmap(model_folder)
        records = {Path(image.name).name: image for image in colmap_images(model)}
        # Images that are missing in the model were not registered and are left out.
        known = {number: (path, records[path.name]) for number, path in color.items() if path.name in records}
        return {number: _matrix(record.camera, path, scene) for number, (path, record) in known.items()}


def _matrix(camera: Camera, path: Path, scene: str) -> NDArray[np.float64]:
    if not is_pinhole(camera):
        raise DataError(
            f"the camera of {path} is {camera.model_name}: the benchmark's images are read as they are; undistort them "
            "with colmap image_undistorter, and give the model that it writes"
        )
    expected = (camera.height, camera.width)
    size, _ = size_on_disk(path, scene, expected, f"the model of scene {scene}")
    return posed_image(camera, expected, size, False, None, str(path)).intrinsics


def moved(similarity: NDArray[np.float64], pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Transforms a camera-to-world pose by a 4x4 similarity; the scale affects the position only."""
    if not np.isfinite(pose).all():
        return np.full((4, 4), np.nan)
    scale = np.cbrt(np.linalg.det(similarity[:3, :3]))
    out = similarity @ pose
    out[:3, :3] /= scale
    return out


def _read_log(path: Path, scene: str) -> list[NDArray[np.float64] | None]:
    """Reads, for each image, a line of three integers and a 4x4 camera-to-world matrix; None if the second is -1."""
    lines = read_text_lines(path, scene)
    try:
        values = np.array(" ".join(lines).split(), np.float64).reshape(-1, 3 + 16)
    except ValueError as error:
        raise DataError(f"{path} of scene {scene}: expected 3 numbers and a 4x4 matrix for each image") from error
    return [None if row[1] < 0 else row[3:].reshape(4, 4) for row in values]


def _read_similarity(path: Path, scene: str) -> NDArray[np.float64]:
    matrix = read_matrix(path, scene, ((4, 4),))
    linear = matrix[:3, :3]
    with np.errstate(all="ignore"):
        scale = np.cbrt(np.linalg.det(linear)) if np.isfinite(matrix).all() else np.nan
        error = np.abs(linear @ linear.T / scale**2 - np.eye(3)).max()
    if not (1e-6 < scale < 1e6 and error < 0.02 and np.abs(matrix[3] - [0, 0, 0, 1]).max() < 1e-6):
        raise DataError(f"{path} of scene {scene} is not a rotation, a scale and a translation: {matrix.tolist()}")
    return matrix


def _log_file(folder: Path) -> Path | None:
    return next(iter(sorted(folder.glob(f"*{_LOG}"))), None) if folder.is_dir() else None


@lru_cache(maxsize=1)  # scans are large, and scenes are read in sequence
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
