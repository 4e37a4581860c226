"""Replica as rendered for NICE-SLAM."""

from pathlib import Path

import numpy as np

from vg2gt.data import Frames
from vg2gt.data.sources import Replica

from .layout_scannet import JPEG_ERROR
from .layouts import Layout, camera_of, camera_to_world, pixels, room, save


def write(root: Path, frames: Frames, scene: str = "office3") -> None:
    folder = root / scene / "results"
    stored = (frames.depth.numpy() * 6553.5 + 0.5).astype(np.uint16)
    for i, image in enumerate(pixels(frames)):
        save(folder / f"frame{i:06d}.jpg", image)
        save(folder / f"depth{i:06d}.png", stored[i])
    np.savetxt(folder.parent / "traj.txt", camera_to_world(frames).reshape(-1, 16))


LAYOUTS = {
    "replica": Layout(
        write,
        lambda root: Replica(root, intrinsics=camera_of(room())),
        image_error=JPEG_ERROR,
        depth_quantum=1 / 6553.5,
    )
}
