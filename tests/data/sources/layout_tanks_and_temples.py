"""Tanks and Temples, without its scan, whose depth is tested by itself (``test_scan_depth.py``)."""

from functools import partial
from pathlib import Path

import numpy as np
import torch

from examples.data_sets.tanks_and_temples import TanksAndTemples
from vg2gt.data import Frames
from vg2gt.io import colmap_from_views, write_colmap
from vg2gt.types import Cameras

from .layouts import SIZE, Layout, camera_to_world, pixels, save

# From the unit and axes of structure from motion to metres in the scan: scale 2.5, half a turn about an axis, a shift.
TO_SCAN = np.array([[0, 2.5, 0, 1.0], [2.5, 0, 0, -4], [0, 0, -2.5, 2], [0, 0, 0, 1]])


def write(root: Path, frames: Frames) -> None:
    """Images 1, 2, ... of which the last is not registered; intrinsics from a COLMAP model in another world."""
    folder = root / "Barn"
    from_scan = np.linalg.inv(TO_SCAN)
    poses = from_scan @ camera_to_world(frames)
    poses[:, :3, :3] *= 2.5
    blocks = []
    for i, image in enumerate((*pixels(frames), pixels(frames)[0])):
        save(folder / f"{i + 1:06d}.png", image)
        registered = i < len(poses)
        pose = poses[i] if registered else np.eye(4)
        rows = [" ".join(repr(float(value)) for value in row) for row in pose]
        blocks.append("\n".join([f"{i} {i if registered else -1} 0", *rows]))
    (folder / "Barn_COLMAP_SfM.log").write_text("\n".join(blocks) + "\n")
    np.savetxt(folder / "Barn_trans.txt", TO_SCAN)
    names = [f"{i + 1:06d}.png" for i in range(len(poses))]
    elsewhere = torch.eye(4, dtype=torch.float64).repeat(1, len(poses), 1, 1)
    cameras = Cameras(elsewhere, frames.intrinsics[None].double(), SIZE)
    write_colmap(folder / "sparse", colmap_from_views(cameras, names))


LAYOUTS = {
    "tanks_and_temples": Layout(write, partial(TanksAndTemples, depth=None), depth_quantum=None, frame_ids=range(1, 7))
}
