"""ScanNet++: iPhone frames among DSLR images."""

from pathlib import Path

import numpy as np

from examples.data_sets.scannetpp import ScanNetPPiPhone
from vg2gt.data import Frames

from .layout_scannet import JPEG_ERROR
from .layouts import Layout, camera_to_world, millimetres, pixels, save


def write(root: Path, frames: Frames) -> None:
    """Frames 0, 10, 20, ...; the cameras' file names them from the last to the first, and one more."""
    folder = root / "processed" / "0a5c013435"
    names = [f"frame_{10 * i:06d}" for i in range(len(frames.images))]
    for name, image, depth in zip(names, pixels(frames), millimetres(frames), strict=True):
        save(folder / "images" / f"{name}.jpg", image)
        save(folder / "depth" / f"{name}.png", depth)
    save(folder / "images" / "DSC00010.jpg", np.zeros((20, 30, 3), np.uint8))
    save(folder / "depth" / "DSC00010.png", np.zeros((20, 30), np.uint16))
    intrinsics = frames.intrinsics.double().numpy()
    intrinsics[:, :2, 2] += 0.5
    poses = camera_to_world(frames)
    write_cameras(folder, [*names, "frame_999990"], [*poses, poses[0]], [*intrinsics, intrinsics[0]])


def write_cameras(folder: Path, names: list[str], poses: list[np.ndarray], intrinsics: list[np.ndarray]) -> None:
    np.savez(
        folder / "scene_iphone_metadata.npz",
        images=np.array([f"{name}.jpg" for name in names[::-1]]),
        trajectories=np.stack(poses[::-1]),
        intrinsics=np.stack(intrinsics[::-1]),
    )


LAYOUTS = {
    "scannetpp_iphone": Layout(
        write, lambda root: ScanNetPPiPhone(str(root)), image_error=JPEG_ERROR, frame_ids=tuple(range(0, 60, 10))
    )
}
