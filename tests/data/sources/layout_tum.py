"""TUM RGB-D: three streams with their own clocks."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from examples.data_sets.tum import TUM
from vg2gt.data import Frames

from .layouts import Layout, camera_of, camera_to_world, pixels, room, save

START = 1305031102.0


def write(root: Path, frames: Frames, scene: str = "rgbd_dataset_freiburg1_desk") -> None:
    """Colour 30 times per second, depth 11 ms later, poses 100 times per second; the lists' last files are absent."""
    folder = root / scene
    stored = (frames.depth.numpy() * 5000 + 0.5).astype(np.uint16)
    stored[stored == 0] = 65535
    count = len(stored)
    times = START + 0.0333 * np.arange(count + 2)
    lists = {"rgb": ["# color images"], "depth": ["# depth maps"]}
    for i, time in enumerate(times):
        for kind, stamp in (("rgb", time), ("depth", time + 0.011)):
            lists[kind].append(f"{stamp:.6f} {kind}/{stamp:.6f}.png")
        if i < count:
            save(folder / lists["rgb"][-1].split()[1], pixels(frames)[i])
            save(folder / lists["depth"][-1].split()[1], stored[i])
    for kind, lines in lists.items():
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n")
    write_poses(folder, times, camera_to_world(frames))


def write_poses(folder: Path, times: np.ndarray, poses: np.ndarray) -> None:
    """Each pose three times, 3 ms before its time with the true one nearest, and 10 ms before and after displaced."""
    rows = []
    for i, time in enumerate(times):
        pose = poses[min(i, len(poses) - 1)]
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
        for shift, displaced in ((-0.010, 1), (-0.003, 0), (0.010, 2)):
            rows.append([time + shift, *(pose[:3, 3] + displaced), *quaternion])
    np.savetxt(folder / "groundtruth.txt", rows, "%.9f", header="timestamp tx ty tz qx qy qz qw")


LAYOUTS = {
    "tum": Layout(write, lambda root: TUM(root, intrinsics=camera_of(room()), holdout=None), depth_quantum=1 / 5000)
}
