"""KITTI: poses against geodesy and against real packets, calibration against real files, which frames there are."""

import numpy as np
import pytest

from vg2gt.data import DataError
from vg2gt.data.sources import KITTI
from vg2gt.data.sources.kitti import imu_to_world, read_calibration

from .layout_kitti import DATE, DRIVE, write
from .layouts import room


@pytest.fixture(scope="module")
def real(shared):
    return shared / "data" / "kitti_raw_2011_09_26" / DATE


def _packet(latitude, longitude, altitude=100.0, roll=0.0, pitch=0.0, yaw=0.0):
    return np.array([latitude, longitude, altitude, roll, pitch, yaw])


def test_positions_are_metres_east_north_up():
    """Against the arcs of a sphere: 200 m along the parallel and the meridian of Karlsruhe."""
    radius, latitude, longitude = 6378137.0, 49.0, 8.4
    east = np.rad2deg(200 / (radius * np.cos(np.deg2rad(latitude))))
    north = np.rad2deg(200 / radius)
    packets = {
        3: _packet(latitude, longitude),
        4: _packet(latitude, longitude + east),
        7: _packet(latitude + north, longitude, 105),
    }
    poses = imu_to_world(packets)
    assert list(poses) == [3, 4, 7]
    np.testing.assert_allclose(poses[3], np.eye(4), atol=0)
    np.testing.assert_allclose(poses[4][:3, 3], [200, 0, 0], atol=1e-6)
    np.testing.assert_allclose(poses[7][:3, 3], [0, 200, 5], atol=0.01)  # the projection stretches by 2e-5 on the way


def test_orientations_are_yaw_pitch_roll():
    """Against a product of rotations written out; yaw is counter-clockwise from east."""
    roll, pitch, yaw = 0.03, -0.2, 2.1
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(a), np.sin(a)) for a in (roll, pitch, yaw))
    expected = np.array([
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ])  # fmt: skip
    pose = imu_to_world({0: _packet(49.0, 8.4, 0.0, roll, pitch, yaw)})[0]
    np.testing.assert_allclose(pose[:3, :3], expected, atol=1e-15)
    np.testing.assert_allclose(imu_to_world({0: _packet(49, 8, 0, yaw=np.pi / 2)})[0][:3, 0], [0, 1, 0], atol=1e-15)


def test_real_calibration(real):
    """The chain reproduces P_rect R_rect T_velo_to_cam T_imu_to_velo on points."""
    fields = {}
    for name in ("cam_to_cam", "velo_to_cam", "imu_to_velo"):
        for line in (real / f"calib_{name}.txt").read_text().splitlines()[1:]:
            key, _, values = line.partition(": ")
            fields[key if name == "cam_to_cam" else f"{name}.{key}"] = np.array(values.split(), float)
    points = np.array([[10.0, 2, -1], [20, -5, 1], [50, 0, 0]]).T  # ahead of the vehicle: x forward, y left, z up
    moved = points
    for name in ("imu_to_velo", "velo_to_cam"):
        moved = fields[f"{name}.R"].reshape(3, 3) @ moved + fields[f"{name}.T"][:, None]
    moved = np.vstack((fields["R_rect_00"].reshape(3, 3) @ moved, np.ones(3)))
    projected = fields["P_rect_02"].reshape(3, 4) @ moved
    intrinsics, camera_from_imu = read_calibration(real, "drive")
    ours = intrinsics @ (camera_from_imu[:3, :3] @ points + camera_from_imu[:3, 3:])
    np.testing.assert_allclose(ours[:2] / ours[2], projected[:2] / projected[2], atol=0.01)
    assert camera_from_imu[2, 0] > 0.999  # the vehicle's forward is the camera's


def test_only_frames_with_depth_and_the_split_count(tmp_path, caplog):
    write(tmp_path, room(3))
    depth = tmp_path / "train" / DRIVE / "proj_depth" / "groundtruth" / "image_02"
    (depth / "0000000006.png").unlink()
    source = KITTI(str(tmp_path))
    assert (source.scenes, tuple(source.frames(DRIVE))) == ((DRIVE,), (5, 7))
    assert "1 of 3 frames without a depth file are left out" in caplog.text
    with pytest.raises(DataError, match="no scene in"):
        KITTI(str(tmp_path), split="val")
    elsewhere = tmp_path / "depth"
    elsewhere.mkdir()
    (tmp_path / "train").rename(elsewhere / "train")
    assert tuple(KITTI(str(tmp_path), depth_root=str(elsewhere)).frames(DRIVE)) == (5, 7)
