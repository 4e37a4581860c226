"""ScanNet: exported, and the raw stream."""

import struct
import zlib
from functools import partial
from pathlib import Path

import numpy as np

from examples.data_sets.scannet_sens import ScanNetSens
from vg2gt.data import Frames
from vg2gt.data.sources import ScanNet

from .layout_rgbd import write_pose_files
from .layouts import Layout, camera_to_world, encoded, millimetres, pixels

JPEG_ERROR = 0.009
"""Mean absolute error of images of the test's room as JPEG of quality 95 (measured: 0.0060 to 0.0077)."""


def write_export(root: Path, frames: Frames, scene: str = "scene0707_00") -> None:
    """Frames 8, 9, 10, ... of a scan."""
    folder = root / "scans" / scene
    intrinsics = write_pose_files(folder, frames, "color")
    intrinsics[:2] *= 2
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", intrinsics)


def sens_header(frames: Frames, count: int, color: int, depth: int) -> bytes:
    height, width = frames.depth.shape[1:]
    intrinsics, name = np.eye(4, dtype="<f4"), b"StructureSensor"
    intrinsics[:3, :3] = frames.intrinsics[0].numpy()
    matrices = [2 * intrinsics, np.eye(4, dtype="<f4"), intrinsics, np.eye(4, dtype="<f4")]
    content = struct.pack("<IQ", 4, len(name)) + name + b"".join(matrix.tobytes() for matrix in matrices)
    return content + struct.pack("<2i4IfQ", color, depth, width, height, width, height, 1000, count)


def sens_frame(pixels: np.ndarray, millimetres: np.ndarray, pose: np.ndarray, jpeg: bool, packed: bool) -> bytes:
    color, depth = encoded(pixels, "JPEG" if jpeg else "PNG"), millimetres.astype("<u2").tobytes()
    depth = zlib.compress(depth) if packed else depth
    return pose.astype("<f4").tobytes() + struct.pack("<4Q", 17, 18, len(color), len(depth)) + color + depth


def write_sens(root: Path, frames: Frames, jpeg: bool = True, packed: bool = True, lost: int | None = None) -> Path:
    """Frames 0, 1, ... of a scan; tracking of one may be lost."""
    path = root / "scans" / "scene0707_00" / "scene0707_00.sens"
    path.parent.mkdir(parents=True)
    poses = camera_to_world(frames)
    if lost is not None:
        poses[lost] = -np.inf
    parts = [
        sens_frame(image, depth, pose, jpeg, packed)
        for image, depth, pose in zip(pixels(frames), millimetres(frames), poses, strict=True)
    ]
    path.write_bytes(sens_header(frames, len(parts), 2 if jpeg else 1, int(packed)) + b"".join(parts) + bytes(8))
    return path


LAYOUTS = {
    "scannet": Layout(write_export, ScanNet, image_error=JPEG_ERROR, frame_ids=range(8, 14)),
    "scannet_sens": Layout(write_sens, ScanNetSens, image_error=JPEG_ERROR),
    "scannet_sens_plain": Layout(partial(write_sens, jpeg=False, packed=False), ScanNetSens),
}
