"""RGB-D folders: one file of poses, one file a pose, 7-Scenes."""

from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from vg2gt.data import Frames, RGBDFolder

from .layouts import Layout, camera_to_world, millimetres, pixels, save


def write_recording(root: Path, frames: Frames, scene: str = "office", first: int = 10, digits: int = 5) -> Path:
    """``images/ depth/ poses.txt K.txt``; frames 10, 11, ... Returns its folder."""
    for i, (image, depth) in enumerate(zip(pixels(frames), millimetres(frames), strict=True)):
        save(root / scene / "images" / f"{i + first:0{digits}d}.png", image)
        save(root / scene / "depth" / f"{i + first:0{digits}d}.png", depth)
    np.savetxt(root / scene / "poses.txt", camera_to_world(frames).reshape(-1, 16))
    np.savetxt(root / scene / "K.txt", frames.intrinsics[0].numpy())
    return root / scene


def write_pose_files(folder: Path, frames: Frames, colour: str = "rgb") -> np.ndarray:
    """Frames 8, 9, 10, ...; returns the intrinsics as the file holds them."""
    for sub in ("pose", "intrinsic"):
        (folder / sub).mkdir(parents=True)
    for i, pose in enumerate(camera_to_world(frames)):
        save(folder / colour / f"{i + 8}.jpg", pixels(frames)[i])
        save(folder / "depth" / f"{i + 8}.png", millimetres(frames)[i])
        np.savetxt(folder / "pose" / f"{i + 8}.txt", pose)
    matrix = np.eye(4)
    matrix[:3, :3] = frames.intrinsics[0].numpy()
    np.savetxt(folder / "intrinsic" / "intrinsic_depth.txt", matrix)
    return matrix


def write_seven_scenes(root: Path, frames: Frames) -> None:
    """One sequence, and the intrinsics next to it."""
    folder = root / "chess" / "seq-01"
    folder.mkdir(parents=True)
    for i, pose in enumerate(camera_to_world(frames)):
        save(folder / f"frame-{i:06d}.color.png", pixels(frames)[i])
        depth = millimetres(frames)[i]
        save(folder / f"frame-{i:06d}.depth.png", np.where(depth == 0, 65535, depth))
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", pose)
    np.savetxt(root / "chess" / "camera-intrinsics.txt", frames.intrinsics[0].numpy())


def _write_rows(root: Path, frames: Frames, quaternions: bool) -> None:
    """Poses as 3x4 matrices, or as a time, a position and a quaternion."""
    folder, poses = write_recording(root, frames), camera_to_world(frames)
    rows = [[9.5, *pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()] for pose in poses]
    np.savetxt(folder / "poses.txt", rows if quaternions else poses[:, :3].reshape(-1, 12), "%.17g")


READ = partial(RGBDFolder, holdout=None)
LAYOUTS = {
    "rgbd": Layout(write_recording, READ, frame_ids=range(10, 16)),
    "rgbd_3x4": Layout(partial(_write_rows, quaternions=False), READ, frame_ids=range(10, 16)),
    "rgbd_quaternions": Layout(partial(_write_rows, quaternions=True), READ, frame_ids=range(10, 16)),
    "rgbd_pose_files": Layout(
        lambda root, frames: write_pose_files(root / "hall", frames), READ, image_error=0.012, frame_ids=range(8, 14)
    ),
    "seven_scenes": Layout(write_seven_scenes, READ),
}
