"""KITTI raw drives with the annotated depth of the depth benchmark and poses from the GPS/IMU unit (OXTS)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from typing_extensions import Unpack

from vg2gt.data.base import DataError
from vg2gt.data.sources.files import FileSource, HoldoutOptions
from vg2gt.data.sources.index import SceneIndex, check_found, make_index
from vg2gt.data.sources.parsing import expanded, numbered, read_numbers, read_text_lines, rigid
from vg2gt.io.cameras_json import invert_pose

_EARTH_RADIUS = 6378137.0
"""Equatorial radius in metres, as in KITTI's own tools."""

_CALIBRATION = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt")
_SPLITS = ("train", "val")
_IMAGES = "image_02/data"


class KITTI(FileSource):
    """Drives of KITTI raw that have annotated depth; a scene is a drive.

    Images are ``<root>/<date>/<drive>_sync/image_02/data/%010d.png``, calibration files are in ``<root>/<date>``, and
    depth is ``<depth_root>/{train,val}/<drive>_sync/proj_depth/groundtruth/image_02/%010d.png`` (uint16, 256 units per
    metre, 0 = none). The first and the last five frames of a drive have no depth and are not used.

    Poses are computed from OXTS packets with a Mercator projection at the drive's first latitude. The world origin is
    the position of the first packet, with axes east, north, up. ``camera <- imu = [I | K^-1 p] R_rect_00 T_velo_to_cam
    T_imu_to_velo`` with ``P_rect = [K | p]``, which reproduces ``P_rect`` exactly.

    Args:
        root: KITTI raw, the folder that contains the dates.
        depth_root: the annotated depth, the folder that contains ``train`` and ``val``; None: the same as ``root``.
        split: the benchmark's ``train`` or ``val`` drives; None: both.
        shared: see ``FileSource``; the frame rate is 10 frames per second.
    """

    layout = "KITTI raw: DATE/DRIVE_sync/image_02/data, with depth for it in {train,val}/DRIVE_sync/proj_depth"
    index_options = ("splits", "depth_root")
    sparse_depth = True
    depth_scale = 256.0

    def __init__(
        self,
        root: str | Sequence[str] | None,
        depth_root: str | None = None,
        split: str | None = None,
        **shared: Unpack[HoldoutOptions],
    ) -> None:
        if split not in (None, *_SPLITS):
            raise ValueError(f"split must be train, val or null (both), got {split!r}")
        self.depth_root = expanded(depth_root)
        self.splits = (split,) if split else _SPLITS
        super().__init__(root, **shared)

    def find(self, root: Path) -> Mapping[str, Path]:
        """Finds the drives that have images and a depth folder."""
        drives = {path.name: path for path in sorted(root.glob("*/*_sync")) if (path / _IMAGES).is_dir()}
        return {name: folder for name, folder in drives.items() if self._depth_folder(folder) is not None}

    def watched(self, scene: str, folder: Path) -> Sequence[Path | None]:
        """Returns the drive's folder, its depth folder and the calibration files."""
        return folder, self._depth_folder(folder), *(folder.parent / name for name in _CALIBRATION)

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Lists the files of a drive and computes its poses."""
        depth_folder = self._depth_folder(folder)
        depth = numbered(depth_folder, scene) if depth_folder else {}
        check_found(scene, folder, {"annotated depth": depth})
        numbers = range(min(depth), max(depth) + 1)
        color = {i: path for i, path in numbered(folder / _IMAGES, scene).items() if i in numbers}
        intrinsics, camera_from_imu = read_calibration(folder.parent, scene)
        packets = numbered(folder / "oxts" / "data", scene, suffixes=(".txt",))
        imu = imu_to_world({number: _read_packet(path, scene) for number, path in packets.items()})
        poses = {i: pose @ invert_pose(camera_from_imu) for i, pose in imu.items() if i in numbers}
        return make_index(scene, folder, color, depth, poses, intrinsics)

    def _depth_folder(self, drive: Path) -> Path | None:
        root = self.depth_root or drive.parents[1]
        inside = f"{drive.name}/proj_depth/groundtruth/image_02"
        return next((root / split / inside for split in self.splits if (root / split / inside).is_dir()), None)


def imu_to_world(packets: Mapping[int, NDArray[np.float64]]) -> dict[int, NDArray[np.float64]]:
    """Computes the poses of the IMU from OXTS packets.

    Args:
        packets: values of each packet by frame number, starting with latitude and longitude in degrees, altitude in
            metres, and roll, pitch and yaw in radians.

    Returns:
        4x4 IMU-to-world poses in metres by frame number, not finite for unusable packets. The origin is at the first
        usable packet: float32 would resolve absolute coordinates (10^6 m) to 0.1 m only.
    """
    if not packets:
        return {}
    values = np.stack([packet[:6] for packet in packets.values()])
    latitude, longitude, altitude, roll, pitch, yaw = values.T
    first = int((np.isfinite(values).all(1) & (np.abs(latitude) < 90)).argmax())
    scale = np.cos(np.deg2rad(latitude[first]))
    with np.errstate(all="ignore"):  # a broken packet gives NaN, which drops its frame
        east = scale * _EARTH_RADIUS * np.deg2rad(longitude)
        north = scale * _EARTH_RADIUS * np.log(np.tan(np.deg2rad(90 + latitude) / 2))
        position = np.stack((east, north, altitude), -1)
        poses = np.tile(np.eye(4), (len(values), 1, 1))
        poses[:, :3, :3] = Rotation.from_euler("xyz", np.stack((roll, pitch, yaw), -1)).as_matrix()
        poses[:, :3, 3] = position - position[first]
    return dict(zip(packets, poses, strict=True))


def read_calibration(folder: Path, scene: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Reads the left colour camera's rectified intrinsics ``[3, 3]`` and the transform ``camera <- imu`` ``[4, 4]``.

    Raises:
        DataError: if a calibration file of the date is missing or invalid.
    """
    cameras, velodyne, imu = (_read_fields(folder / name, scene) for name in _CALIBRATION)
    where = f"{folder} (calibration of scene {scene})"
    projection = _field(cameras, "P_rect_02", (3, 4), where)
    rectify = np.eye(4)
    rectify[:3, :3] = _field(cameras, "R_rect_00", (3, 3), where)
    intrinsics = projection[:, :3]
    if abs(np.linalg.det(intrinsics)) < 1e-6:
        raise DataError(f"P_rect_02 in {where} is not a projection: {projection.tolist()}")
    shift = np.eye(4)
    shift[:3, 3] = np.linalg.solve(intrinsics, projection[:, 3])
    steps = np.stack((rectify, _transform(velodyne, where), _transform(imu, where)))
    rectify, camera_from_velodyne, velodyne_from_imu = rigid(steps, range(3), f"the calibration files of {where}")
    return intrinsics, shift @ rectify @ camera_from_velodyne @ velodyne_from_imu


def _read_packet(path: Path, scene: str) -> NDArray[np.float64]:
    packet = read_numbers(path, scene)[0]
    if len(packet) < 6:
        raise DataError(f"{path} of scene {scene} is not an OXTS packet: it has {len(packet)} numbers, expected 30")
    return packet[:6]


def _read_fields(path: Path, scene: str) -> dict[str, str]:
    lines = [line.partition(":") for line in read_text_lines(path, scene)]
    return {name.strip(): value for name, _, value in lines}


def _field(fields: Mapping[str, str], name: str, shape: tuple[int, int], where: str) -> NDArray[np.float64]:
    try:
        values = np.array([float(word) for word in fields[name].split()]).reshape(shape)
    except (KeyError, ValueError) as error:
        raise DataError(f"{name} in {where} should be {shape[0]}x{shape[1]} numbers: {error!r}") from error
    if not (np.abs(values) < 1e6).all():
        raise DataError(f"{name} in {where} is not finite and of sensible size: {values.tolist()}")
    return values


def _transform(fields: Mapping[str, str], where: str) -> NDArray[np.float64]:
    transform = np.eye(4)
    transform[:3, :3] = _field(fields, "R", (3, 3), where)
    transform[:3, 3] = _field(fields, "T", (3, 1), where)[:, 0]
    return transform
