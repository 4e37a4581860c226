"""ScanNet: exported, and the raw stream."""

import io
import struct
import zlib
from pathlib import Path

import numpy as np
from PIL import Image

from examples.data_sets.scannet_sens import ScanNetSens
from vg2gt.data import Frames
from vg2gt.data.sources import ScanNet

from .layouts import Layout, camera_to_world, millimetres, pixels, save

JPEG_ERROR = 0.009
"""Mean absolute error of images of the test's room as JPEG of quality 95 (measured: 0.0060 to 0.0077)."""


def write_export(root: Path, frames: Frames, scene: str = "scene0707_00") -> None:
    """Frames 8, 9, 10, ... of a scan."""
    folder = root / "scans" / scene
    for kind in ("color", "depth", "pose", "intrinsic"):
        (folder / kind).mkdir(parents=True)
    for i, pose in enumerate(camera_to_world(frames)):
        save(folder / "color" / f"{i + 8}.jpg", pixels(frames)[i])
        save(folder / "depth" / f"{i + 8}.png", millimetres(frames)[i])
        np.savetxt(folder / "pose" / f"{i + 8}.txt", pose)
    intrinsics = np.eye(4)
    intrinsics[:3, :3] = frames.intrinsics[0].numpy()
    np.savetxt(folder / "intrinsic" / "intrinsic_depth.txt", intrinsics)
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
    stream = io.BytesIO()
    if jpeg:
        Image.fromarray(pixels).save(stream, "JPEG", quality=95, subsampling=0)
    else:
        Image.fromarray(pixels).save(stream, "PNG")
    color, depth = stream.getvalue(), millimetres.astype("<u2").tobytes()
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


def _write_stream(root: Path, frames: Frames) -> None:
    write_sens(root, frames)


def _write_plain_stream(root: Path, frames: Frames) -> None:
    write_sens(root, frames, jpeg=False, packed=False)


LAYOUTS = {
    "scannet": Layout(
        write_export, lambda root: ScanNet(str(root)), image_error=JPEG_ERROR, frame_ids=tuple(range(8, 14))
    ),
    "scannet_sens": Layout(_write_stream, lambda root: ScanNetSens(str(root)), image_error=JPEG_ERROR),
    "scannet_sens_plain": Layout(_write_plain_stream, lambda root: ScanNetSens(str(root))),
}
