"""KITTI raw with annotated depth."""

from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from vg2gt.data import Frames
from vg2gt.data.sources import KITTI

from .layouts import Layout, camera_to_world, pixels, save

DATE, DRIVE = "2011_09_26", "2011_09_26_drive_0001_sync"
RADIUS = 6378137.0

# Made up, but as uneven as real ones.
R_RECT, IMU_TO_VELO, VELO_TO_CAM = Rotation.from_matrix([
    [[0.9999, 0.0098, -0.0074], [-0.0099, 0.9999, -0.0043], [0.0074, 0.0044, 0.9999]],
    [[0.99999, 0.00075, -0.0021], [-0.00078, 0.9999, -0.0148], [0.002, 0.0148, 0.9999]],
    [[0.0075, -0.99997, -0.0006], [0.0148, 0.0007, -0.99989], [0.99986, 0.0075, 0.0148]],
]).as_matrix()  # fmt: skip
STEPS = {"velo_to_cam": (VELO_TO_CAM, [0, -0.08, -0.27]), "imu_to_velo": (IMU_TO_VELO, [-0.81, 0.32, -0.8])}
BASE = np.array([0.0598, -0.0004, 0.0027])


def transform(rotation: np.ndarray, translation: list[float]) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation, translation
    return out


def write(root: Path, frames: Frames) -> None:
    """A drive of which frames 5, 6, ... have depth; five before and five after have none."""
    intrinsics = frames.intrinsics[0].double().numpy()
    _write_calibration(root / DATE, intrinsics)
    velo_to_cam, imu_to_velo = (transform(*step) for step in STEPS.values())
    imu = camera_to_world(frames) @ transform(R_RECT, BASE.tolist()) @ velo_to_cam @ imu_to_velo
    imu[:, :3, 3] -= imu[0, :3, 3]  # the first packet's latitude fixes the projection's scale
    drive, depth_folder = root / DATE / DRIVE, root / "train" / DRIVE / "proj_depth" / "groundtruth" / "image_02"
    (drive / "oxts" / "data").mkdir(parents=True)
    count = len(imu)
    for number in range(count + 10):
        i = min(max(number - 5, 0), count - 1)
        save(drive / "image_02" / "data" / f"{number:010d}.png", pixels(frames)[i])
        (drive / "oxts" / "data" / f"{number:010d}.txt").write_text(packet(imu[i]))
        if number == i + 5:
            stored = (frames.depth[i].numpy() * 256 + 0.5).astype(np.uint16)
            save(depth_folder / f"{number:010d}.png", stored)


def packet(imu_to_world: np.ndarray, latitude: float = 49.0, longitude: float = 8.4) -> str:
    """An OXTS packet of a pose in a world whose origin is at this latitude and longitude."""
    scale = np.cos(np.deg2rad(latitude))
    x, y, z = imu_to_world[:3, 3]
    north = RADIUS * np.log(np.tan(np.pi / 4 + np.deg2rad(latitude) / 2)) + y / scale
    lat = 2 * np.rad2deg(np.arctan(np.exp(north / RADIUS))) - 90
    lon = longitude + np.rad2deg(x / (scale * RADIUS))
    angles = Rotation.from_matrix(imu_to_world[:3, :3]).as_euler("xyz")  # roll, pitch, yaw
    return " ".join(repr(float(value)) for value in (lat, lon, 116 + z, *angles)) + " 0" * 24


def _write_calibration(folder: Path, intrinsics: np.ndarray) -> None:
    folder.mkdir(parents=True)
    projection = np.concatenate((intrinsics, (intrinsics @ BASE)[:, None]), 1)
    fields = {"S_rect_02": [40.0, 30.0], "R_rect_00": R_RECT, "P_rect_02": projection}
    _write_fields(folder / "calib_cam_to_cam.txt", fields)
    for name, (rotation, translation) in STEPS.items():
        _write_fields(folder / f"calib_{name}.txt", {"R": rotation, "T": translation})


def _write_fields(path: Path, fields: dict) -> None:
    lines = [f"{name}: " + " ".join(f"{x:.15e}" for x in np.ravel(values)) for name, values in fields.items()]
    path.write_text("calib_time: 09-Jan-2012 13:57:47\n" + "\n".join(lines) + "\n")


LAYOUTS = {
    "kitti": Layout(
        write, partial(KITTI, split="train"), depth_quantum=1 / 256, frame_ids=range(5, 11), moved_world=True
    ),
}
