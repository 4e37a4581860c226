"""Virtual KITTI 2: one camera of one variation."""

from pathlib import Path

import numpy as np

from examples.data_sets.virtual_kitti import VirtualKITTI2
from vg2gt.data import Frames

from .layout_scannet import JPEG_ERROR
from .layouts import Layout, pixels, save

POSE_HEADING = "frame cameraID r1,1 r1,2 r1,3 t1 r2,1 r2,2 r2,3 t2 r3,1 r3,2 r3,3 t3 0 0 0 1"
CAMERA_HEADING = "frame cameraID K[0,0] K[1,1] K[0,2] K[1,2]"


def write(root: Path, frames: Frames, variation: str = "Scene06/fog", camera: int = 0) -> None:
    """Frames 0, 1, ... of a camera; the text files hold a second, displaced camera too. No depth is sky."""
    folder = root / variation
    centimetres = np.where(frames.depth.numpy() > 0, frames.depth.numpy() * 100 + 0.5, 65535).astype(np.uint16)
    poses, cameras = [], []
    for i, image in enumerate(pixels(frames)):
        colour = folder / "frames/rgb" / f"Camera_{camera}" / f"rgb_{i:05d}.jpg"
        save(colour, image)
        save(folder / "frames/depth" / f"Camera_{camera}" / f"depth_{i:05d}.png", centimetres[i])
        matrix, pose = frames.intrinsics[i].numpy(), frames.world_to_camera[i].double().numpy()
        for number in (0, 1):
            displaced = pose + np.eye(4)[:, :1] @ np.eye(4)[3:] * (number - camera)
            poses.append([i, number, *displaced.flatten()])
            cameras.append([i, number, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
    np.savetxt(folder / "extrinsic.txt", poses, "%.9g", header=POSE_HEADING, comments="")
    np.savetxt(folder / "intrinsic.txt", cameras, "%.9g", header=CAMERA_HEADING, comments="")


LAYOUTS = {
    "virtual_kitti": Layout(write, lambda root: VirtualKITTI2(str(root)), image_error=JPEG_ERROR, depth_quantum=0.01)
}
